"""From a task to an agent: every part is a public module of the library."""

from copy import deepcopy
from dataclasses import dataclass
from functools import partial

import torch
from tasks import Task
from tensordict import TensorDict
from torchrl.envs import Compose, DoubleToFloat, EnvBase, GymEnv, SerialEnv, TransformedEnv

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Ensemble, Oracle
from afm_rl.learning import (
    GaussianNLLLoss,
    OnlineUpdater,
    OracleUpdater,
    ResetAdam,
    UnmatchedUpdater,
    Updater,
    collect,
    fit_ensemble,
)
from afm_rl.manifold import Manifold
from afm_rl.planning import ICEM, MPPI, KnownReward, PlanningEnv
from afm_rl.regimes import ActionGain, Bias, Regime
from afm_rl.regimes import Compose as Regimes
from afm_rl.transforms import ActionFlowTransform, RegimeTransform

METHODS = ("frozen", "online", "afm", "afm_online", "oracle")
EXECUTED = ("next", "afm", "executed_action")
GATE = 0.99  # quantile of the innovation under nominal dynamics that is still let pass


def make(task: Task, count: int, *transforms) -> TransformedEnv:
    """Return ``count`` environments as one, with transforms in this order."""
    whole = SerialEnv(count, lambda: GymEnv(task.id, max_episode_steps=task.steps))
    chain = Compose(*transforms)
    if whole.observation_spec["observation"].dtype is torch.float64:
        at = 1 if transforms and isinstance(transforms[0], RegimeTransform) else 0
        chain.insert(at, DoubleToFloat(in_keys=["observation"]))
    return TransformedEnv(whole, chain)


def regimes_of(env: EnvBase) -> Regime:
    """Return gains and offsets of all actuators of an environment."""
    space = env.action_spec_unbatched.space
    half, axes = ((space.high - space.low) / 2).tolist(), range(len(space.low))
    gains = ActionGain([f"gain_{axis}" for axis in axes], low=0.3, high=1.5)
    biases = Bias([f"bias_{axis}" for axis in axes], half, span=(-0.3, 0.3))
    return Regimes({"gain": gains, "bias": biases}, prior=[["gain"], ["bias"], ["gain", "bias"]])


def plan(task: Task, model, env: EnvBase, seed: int) -> MPPI | ICEM:
    """Return the planner over a model."""
    space = env.action_spec_unbatched.space
    world = PlanningEnv(model, KnownReward(task.reward), space.low, space.high)
    return task.search(world, seed=seed, **task.planner)


@dataclass
class Learned:
    """What is learned before the change is met."""

    model: Ensemble
    flow: ActionFlow
    regime: Regime


def learn(task: Task, seed: int) -> Learned:
    """Learn a model from random and planned transitions; the universal flow needs no training."""
    env = make(task, 4)
    space = env.action_spec_unbatched.space
    size = env.observation_spec_unbatched["observation"].shape[-1]
    states = Manifold(size)
    model, parts = None, []
    for number, frames in enumerate(task.rounds):
        policy, world = None, env
        if model is not None:
            policy = plan(task, model, env, seed)
            world = make(task, 4, policy.make_tensordict_primer())
        parts.append(collect(world, policy, frames, seed=100 * seed + number)[:])
        data = torch.cat(parts)
        settings = {"hidden": task.hidden, "propagation": "member", "seed": seed}
        model = Ensemble(states, len(space.low), range(size), **settings)
        error = fit_ensemble(model, data, seed=seed, **task.fit).error
        reward = parts[-1]["next", "reward"].mean()
        print(
            f"{len(data)} transitions, the latest with a reward of {reward:.2f} per step: "
            f"held-out error {error:.3f}",
            flush=True,
        )
    flow = ActionFlow(space.low, space.high, saturation="clip")
    learned = Learned(model, flow, regimes_of(env))
    calibrate(task, learned, seed)
    return learned


def calibrate(task: Task, learned: Learned, seed: int) -> None:
    """Set the gate to what the model meets in an episode without any change."""
    watch = ActionFlowTransform(learned.model, learned.flow, enabled=False)
    env = make(task, 2)
    planner = plan(task, learned.model, env, seed)
    env = make(task, 2, watch, planner.make_tensordict_primer())
    env.set_seed(1000 + seed)
    data = env.rollout(task.steps, planner, break_when_any_done=False)
    learned.flow.gate = float(data["next", "afm", "innovation"].quantile(GATE))
    print(f"gate: {learned.flow.gate:.1f} standard deviations", flush=True)


@dataclass
class Agent:
    """Environment, planner and updater of one method, sharing one model."""

    env: TransformedEnv
    planner: MPPI | ICEM
    updater: Updater

    @torch.no_grad()
    def run(self, steps: int, seed: int) -> TensorDict:
        """Return the transitions of one episode per environment, ``(B, T)``."""
        self.env.set_seed(seed)
        td, kept = self.env.reset(), []
        self.updater.start(td)
        for _ in range(steps):
            td, following = self.env.step_and_maybe_reset(self.planner(td))
            self.updater(td)
            kept.append(td)
            td = following
        return torch.stack(kept, 1)


def compose(task: Task, method: str, learned: Learned, seed: int, lr: float = 1e-3) -> Agent:
    """Put an agent together; its environments change half-way, one for each change."""
    model, flow, regime = deepcopy(learned.model), learned.flow, learned.regime
    rows = torch.stack([regime.encode(change) for change in task.changes.values()])
    phases = torch.stack([torch.tensor(regime.identity).expand_as(rows), rows], 1)
    change = RegimeTransform(regime, phases, at=[task.steps // 2])
    if "online" in method:
        model.expand_(len(rows))
    if method == "oracle":
        model = Oracle(model, regime)
    planner = plan(task, model, make(task, 1), seed)
    transforms = [change, planner.make_tensordict_primer()]
    loss = GaussianNLLLoss(model)
    if "afm" in method:
        transforms.insert(1, ActionFlowTransform(model, flow))
        loss.set_keys(action=EXECUTED)
    learner = partial(OnlineUpdater, optimizer=partial(ResetAdam, lr=lr))
    if method == "online":
        updater = learner(loss)
    elif method == "afm_online":  # the transform undoes what actions can: learn the rest
        updater = UnmatchedUpdater(loss, learner, flow.scale, flow.gate)
    elif method == "oracle":
        updater = OracleUpdater(loss, regime_key=("regime", "parameters"))
    else:
        updater = Updater(loss)
    return Agent(make(task, len(rows), *transforms), planner, updater)
