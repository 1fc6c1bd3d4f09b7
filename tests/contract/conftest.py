"""Every public module in one table, so that one contract holds for all."""

import copy
from functools import partial
from typing import NamedTuple

import pytest
import torch
from harness import BOX, loss_by_row
from pushing import push
from tensordict import TensorDict

from afm_rl.correction import ActionFlow, L1Augmentation, LeastSquares, PaperFlow
from afm_rl.dynamics import KNODE, Calibrated, Dubins, Ensemble, KnownDynamics, Oracle, Quadrotor
from afm_rl.learning import (
    GaussianNLLLoss,
    OnlineUpdater,
    ResetAdam,
    RLSUpdater,
    StreamXUpdater,
    UnmatchedUpdater,
    Updater,
)
from afm_rl.planning import CEM, ICEM, MPC, MPPI, GoalDistance, PlanningEnv, TrackingCost
from afm_rl.regimes import ActionGain
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowPolicy


class Case(NamedTuple):
    """How a kind of module is made, and what it says."""

    make: object
    """``make(seed) -> module``, in single precision."""
    say: object
    """``say(module, batch, dtype=..., device=...) -> tensors``, each of leading shape ``batch``."""


def small(seed=0, **settings):
    manifold = Manifold(3, angles=[2])
    return Ensemble(manifold, 2, features=[2], members=2, hidden=[8], seed=seed, **settings)


def draw(batch, *shape, seed=0, dtype=torch.float32, device="cpu"):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*batch, *shape, generator=generator, dtype=torch.float64).to(device, dtype)


def transition(batch, **kind):
    data = {"observation": draw(batch, 3, **kind), "action": draw(batch, 2, **kind)}
    data["next"] = {"observation": draw(batch, 3, seed=1, **kind)}
    return TensorDict(data, batch)


def predict(model, batch, **kind):
    state = draw(batch, model.state_size, **kind)
    action = draw(batch, model.action_size, **kind)
    expected, noise = model.forecast(state, action)
    return model(state, action), expected, noise, model.jacobian(state, action)


def correct(corrector, batch, **kind):
    box = torch.tensor([[-1.0, -1.5], [1.0, 1.5]], **kind).expand(*batch, 2, 2)
    model = Dubins().to(**kind)
    memory, said = corrector.begin(draw(batch, 3, **kind)), []
    for seed in range(3):
        memory, found = corrector.correct(memory, draw(batch, 2, seed=seed, **kind), model, box)
        memory = corrector.observe(memory, draw(batch, 3, seed=seed + 3, **kind))
        said += [x for x in found if x is not None and x.is_floating_point()]
    return (*said, *memory.values())


def plan(planner, batch, **kind):
    entries = {key: draw(batch, size, **kind) for key, size in (("goal", 2), ("reference", 2))}
    td = TensorDict({**entries, "observation": draw(batch, 3, **kind)}, batch, kind.get("device"))
    for key, shape in getattr(planner, "memory", {}).items():
        td[key] = draw(batch, *shape, **kind)
    torch.manual_seed(0)  # TorchRL's own draw from the global generator
    out = planner(td.select(*planner.in_keys))
    return tuple(out[key] for key in planner.out_keys)


def execute(policy, batch, **kind):
    td = policy.make_tensordict_primer()(TensorDict({}, batch))
    executed = []
    for seed in range(3):
        td["observation"], td["action"] = (draw(batch, n, seed=seed, **kind) for n in (3, 2))
        td = policy(td)
        executed.append(td["action"])
        td = td.update(td.pop("next"))
    return tuple(executed)


def measure(loss, batch, **kind):
    return (loss(transition(batch, **kind))["loss_nll"],)


def learn(updater, batch, **kind):
    rows = transition(batch, **kind)
    return updater(rows)["loss"], updater(rows)["loss"]


def world(seed=0, cost=None, dtype=torch.float32):
    box = (bound.to(dtype) for bound in BOX)
    return PlanningEnv(small(seed).to(dtype), copy.deepcopy(cost) or GoalDistance(), *box)


def planner(kind, seed=0, dtype=torch.float32, cost=None, **settings):
    return kind(world(seed, cost, dtype), horizon=3, **settings)


def updater(kind, *more, seed=0, dtype=torch.float32, **settings):
    model = small(seed, **settings).to(dtype)
    return kind(GaussianNLLLoss(model), *more)


def policy(seed=0, dtype=torch.float32):
    flow = ActionFlow(*BOX).to(dtype)
    return ActionFlowPolicy(Dubins().to(dtype), world(dtype=dtype).action_spec, flow)


FEW = {"candidates": 12, "iterations": 2}
ADAM = partial(ResetAdam, lr=1e-2)
TRACKING = TrackingCost([1.0, 1.0, 0.0], [0.01, 0.01], coordinates=[0, 1])

MODULES = {
    "Dubins": Case(lambda seed: Dubins(), predict),
    "Ensemble": Case(small, predict),
    "Ensemble with running statistics": Case(
        lambda seed: small(seed, init="sparse", layer_norm=True, running_count=10), predict
    ),
    "KnownDynamics": Case(lambda seed: KnownDynamics(push, Manifold(3), 2), predict),
    "Calibrated": Case(lambda seed: Calibrated(small(seed), torch.ones(2)), predict),
    "Oracle": Case(lambda seed: Oracle(Dubins(), ActionGain(["v", "omega"])), predict),
    "Quadrotor": Case(lambda seed: Quadrotor(), predict),
    "KNODE": Case(lambda seed: KNODE(Quadrotor()), predict),
    "ActionFlow": Case(lambda seed: ActionFlow(*BOX, context_coordinates=[0, 1]), correct),
    "PaperFlow": Case(lambda seed: PaperFlow(*BOX, [2], 3, gate=0.1, width=8, seed=seed), correct),
    "LeastSquares gain": Case(lambda seed: LeastSquares(*BOX), correct),
    "LeastSquares affine": Case(lambda seed: LeastSquares(*BOX, form="affine"), correct),
    "L1Augmentation": Case(lambda seed: L1Augmentation(*BOX, dt=0.2), correct),
    "MPPI": Case(partial(planner, MPPI, **FEW), plan),
    "ICEM": Case(partial(planner, ICEM, **FEW, elites=3), plan),
    "MPC": Case(partial(planner, MPC, cost=TRACKING), plan),
    "CEM": Case(partial(planner, CEM, **FEW, elites=3), plan),
    "ActionFlowPolicy": Case(policy, execute),
    "GaussianNLLLoss": Case(lambda seed: loss_by_row(small(seed)), measure),
    "Updater": Case(partial(updater, Updater), learn),
    "OnlineUpdater": Case(partial(updater, OnlineUpdater, ADAM), learn),
    "RLSUpdater": Case(
        lambda seed: RLSUpdater(GaussianNLLLoss(Calibrated(small(seed), torch.ones(2)))), learn
    ),
    "StreamXUpdater": Case(partial(updater, StreamXUpdater, init="sparse", layer_norm=True), learn),
    "UnmatchedUpdater": Case(
        partial(updater, UnmatchedUpdater, partial(OnlineUpdater, optimizer=ADAM), BOX[1]), learn
    ),
}
BUILT_IN_PRECISION = ("ActionFlowPolicy", "MPPI", "ICEM", "MPC", "CEM")


COMPILED_SMALLER = {  # what is compiled is the updater: a model in closed form has fewer operations
    "RLSUpdater": Case(
        lambda seed: RLSUpdater(GaussianNLLLoss(Calibrated(Dubins(), torch.ones(2)))), learn
    )
}


def case_of(name, modules=MODULES):
    """Return ``make(seed=0, dtype=float32)`` and ``say(module, batch, dtype=...)`` of a module."""
    made = modules[name]

    def make(seed=0, dtype=torch.float32):
        if name in BUILT_IN_PRECISION:
            return made.make(seed=seed, dtype=dtype)
        return made.make(seed=seed).to(dtype)

    return Case(make, made.say)


@pytest.fixture(params=MODULES)
def case(request):
    """Each module in turn."""
    return case_of(request.param)


@pytest.fixture(params=MODULES)
def compiled_case(request):
    """Each module, as it is compiled."""
    return case_of(request.param, MODULES | COMPILED_SMALLER)


@pytest.fixture(params=MODULES)
def movable_case(request):
    """The name of each module whose results do not depend on the device, and the module."""
    return request.param, case_of(request.param)
