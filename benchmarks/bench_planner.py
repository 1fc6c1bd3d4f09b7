"""Planning step against its bare matrix products, and what the parts around it cost.

    python benchmarks/bench_planner.py

One mission, 1000 candidates, horizon 5, ensemble of 5 x (200, 200, 200), float32, one thread.
Everything is timed in turns within one run, so the ratios hold when the machine's speed drifts. AFM
is timed where it has nothing to do, and where it corrects every action.
"""

from __future__ import annotations

from statistics import median

import torch
from tensordict import TensorDict, TensorDictBase
from timing import timed
from torchrl.envs import EnvBase, TransformedEnv

from afm_rl.correction import ActionFlow
from afm_rl.correction.hypotheses import HYPOTHESES, IDENTITY
from afm_rl.dynamics import Dubins, DynamicsModel, Ensemble
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam
from afm_rl.manifold import Manifold
from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
from afm_rl.transforms import ActionFlowTransform

POPULATION, HORIZON, HIDDEN, ROUNDS = 1000, 5, (200, 200, 200), 40
CORRECTING = [name for name in HYPOTHESES if name != IDENTITY]


def ensemble(seed: int) -> Ensemble:
    """Return an untrained ensemble."""
    return Ensemble(Manifold(3, angles=[2]), 2, features=[2], hidden=HIDDEN, seed=seed)


def warm(env: EnvBase) -> TensorDictBase:
    """Return what a step starts from when the memory of the transform is full."""
    td = env.reset()
    for _ in range(50):
        td = env.step_mdp(env.step(td.set("action", torch.tensor([0.5, 0.7]))))
    return td.set("action", torch.ones(2))


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    low, high = torch.tensor([-1.0, -1.57]), torch.tensor([1.0, 1.57])
    model = ensemble(0)
    world = PlanningEnv(model, GoalDistance(), low, high)
    planner = MPPI(world, horizon=HORIZON, population=POPULATION)
    env = TransformedEnv(world, planner.make_tensordict_primer())
    td = env.reset().set("goal", torch.ones(2))
    cases = {  # model, robot, and what the flow may believe
        "silent, over physics": (Dubins(), Dubins(), list(HYPOTHESES)),
        "correcting, over the ensemble": (model, ensemble(1), CORRECTING),
        "correcting, over physics": (Dubins(), model, CORRECTING),
    }

    def with_afm(model: DynamicsModel, robot: DynamicsModel, hypotheses: list[str]):
        flow = ActionFlow(low, high, hypotheses, place=[0, 1], gate=1e-6)
        plain = PlanningEnv(robot, GoalDistance(), low, high)
        env = TransformedEnv(plain, ActionFlowTransform(model, flow))
        start = warm(env)
        return lambda: env.step(start.clone())

    jobs = {f"with AFM, {name}": with_afm(*parts) for name, parts in cases.items()}
    plain_td = world.reset().set("action", torch.ones(2))
    learner = ensemble(0)
    updater = OnlineUpdater(GaussianNLLLoss(learner), ResetAdam)
    transition = TensorDict({"observation": torch.zeros(3), "action": torch.ones(2)})
    transition["next", "observation"] = torch.ones(3)
    weights = [weight.detach() for weight in model.weights]
    weights[-1] = weights[-1][..., :3].contiguous()  # the planner needs the means only
    rows = torch.randn(5, POPULATION, 3)

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
            **jobs,
            "online update": lambda: updater(transition),
        },
        ROUNDS,
    )
    bare = median(spent["matrix products"])
    print(f"{'':28}{'ms (median)':>14}{'/ products':>12}")
    for name, values in spent.items():
        print(f"{name:28}{median(values):14.2f}{median(values) / bare:12.3f}")
    pairs = zip(spent["planning step"], spent["matrix products"], strict=True)
    print(f"planning step / matrix products, round by round: {median(a / b for a, b in pairs):.3f}")
    step, plan = (median(spent[name]) for name in ("environment step", "planning step"))
    for name in jobs:
        extra = median(spent[name]) - step
        print(f"{name}: adds {extra:.2f} ms, {extra / plan:.1%} of a plan")


if __name__ == "__main__":
    main()
