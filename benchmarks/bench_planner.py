"""Planning step against its bare matrix products, and what the parts around it cost.

    python benchmarks/bench_planner.py

One mission, 1000 candidates, horizon 5, ensemble of 5 x (200, 200, 200), float32, one thread.
Everything is timed in turns within one run, so the ratios hold when the machine's speed drifts. AFM
is timed where it has nothing to do, and where it corrects every action, as it is and as machine
code (which is compiled at first, for a minute or two), against the same environment without it.
Times are those of this thread alone, so that other programs disturb them little.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch
from tensordict import TensorDict, TensorDictBase
from timing import timed
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from afm_rl.correction import ActionFlow
from afm_rl.dynamics import Dubins, DynamicsModel, Ensemble, KnownDynamics
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

POPULATION, HORIZON, HIDDEN, ROUNDS = 1000, 5, (200, 200, 200), 40


def ensemble(seed: int) -> Ensemble:
    """Return an untrained ensemble."""
    return Ensemble(Manifold(3, angles=[2]), 2, features=[2], hidden=HIDDEN, seed=seed)


class Axes(KnownDynamics):
    """Six axes that move by a multiple of their action."""

    def __init__(self, gain: float) -> None:
        super().__init__(lambda s, a: s + gain * a, Manifold(6), 6, affine=True)
        self.gain = gain

    def jacobian(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the closed form."""
        return self.gain * torch.eye(6).expand(*action.shape, 6)


def warm(env: EnvBase) -> TensorDictBase:
    """Return what a step starts from when the memory of the transform is full."""
    td, size = env.reset(), env.action_spec.shape[-1]
    for k in range(50):
        td = env.step_mdp(env.step(td.set("action", torch.linspace(0.5, 0.7, size) * (k % 3 - 1))))
    return td.set("action", torch.ones(size))


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    low, high = torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57])
    model = ensemble(0)
    world = PlanningEnv(model, GoalDistance(), low, high)
    planner = MPPI(world, horizon=HORIZON, population=POPULATION)
    env = TransformedEnv(world, planner.make_tensordict_primer())
    td = env.reset().set("goal", torch.ones(2))
    cases = {  # model and robot
        "silent, over physics": (Dubins(), Dubins()),
        "over physics": (Dubins(), model),
        "over the ensemble": (model, ensemble(1)),
        "six actions": (Axes(1.0), Axes(-0.7)),
    }

    def with_afm(
        model: DynamicsModel, robot: DynamicsModel, compile: bool
    ) -> tuple[Callable, Callable]:
        """Return a step with the correction, and the same one without."""
        size = model.action_size
        ends = (low, high) if size == 2 else (-torch.ones(size), torch.ones(size))
        place = [0, 1] if size == 2 else []
        flow = ActionFlow(*ends, place=place, compile=compile)
        plain = PlanningEnv(robot, GoalDistance(range(min(2, size))), *ends)
        env = TransformedEnv(plain, ActionFlowTransform(model, flow))
        start, alone = warm(env), warm(plain)
        return lambda: env.step(start.copy()), lambda: plain.step(alone.copy())

    pairs = {
        f"AFM, {name}{', compiled' if compiled else ''}": with_afm(*parts, compiled)
        for name, parts in cases.items()
        for compiled in (False, True)
    }
    plain_td = world.reset().set("action", torch.ones(2))
    learner = ensemble(0)
    updater = OnlineUpdater(GaussianNLLLoss(learner), ResetAdam)
    transition = TensorDict({"observation": torch.zeros(3), "action": torch.ones(2)})
    transition["next", "observation"] = torch.ones(3)
    weights = [weight.detach() for weight in model.weights]
    weights[-1] = weights[-1][..., :3].contiguous()  # the planner needs the means only
    rows = torch.randn(5, POPULATION, weights[0].shape[1])

    @torch.no_grad()
    def products() -> None:
        for _ in range(HORIZON):
            hidden = rows
            for weight in weights:
                hidden = torch.bmm(hidden, weight)

    spent = timed(
        {
            "matrix products": products,
            "planning step": lambda: planner(td.clone()),
            "environment step": lambda: world.step(plain_td.clone()),
            **{name: job for name, (job, _) in pairs.items()},
            **{f"without, {name}": job for name, (_, job) in pairs.items()},
            "online update": lambda: updater(transition),
        },
        ROUNDS,
        clock=time.thread_time,
    )
    bare = median(spent["matrix products"])
    print(f"{'':36}{'ms (median)':>14}{'/ products':>12}")
    for name, values in spent.items():
        print(f"{name:36}{median(values):14.2f}{median(values) / bare:12.3f}")
    turns = zip(spent["planning step"], spent["matrix products"], strict=True)
    print(f"planning step / matrix products, round by round: {median(a / b for a, b in turns):.3f}")
    plan = median(spent["planning step"])
    for name in pairs:
        extra = median(spent[name]) - median(spent[f"without, {name}"])
        print(f"{name}: adds {extra:.2f} ms, {extra / plan:.1%} of a plan")


if __name__ == "__main__":
    main()
