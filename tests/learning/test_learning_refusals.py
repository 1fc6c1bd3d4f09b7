"""What cannot be learnt, or from, is refused by name, in one line."""

from functools import partial

import torch
from harness import refused
from tensordict import TensorDict
from torchrl.envs import GymEnv

from afm_rl.dynamics import KNODE, Dubins, Ensemble, Quadrotor
from afm_rl.learning import (
    GaussianNLLLoss,
    KNODEUpdater,
    OnlineUpdater,
    ResetAdam,
    RLSUpdater,
    StreamXUpdater,
    UnmatchedUpdater,
    collect,
    fit_ensemble,
    pretrain_ensemble,
    pretrain_knode,
)
from afm_rl.spaces.manifold import Manifold

BOX = torch.tensor([0.0, 0.0, -3.14]), torch.tensor([0.0, 0.0, 3.14])
GRADIENT = partial(OnlineUpdater, optimizer=ResetAdam)


def ensemble():
    return Ensemble(Manifold(3, angles=[2]), 2, features=[2], members=2, hidden=[4])


def over(model, kind, *settings, **more):
    return kind(GaussianNLLLoss(model), *settings, **more)


def beside(scale=(1.0, 1.5), updater=GRADIENT):
    return over(ensemble(), UnmatchedUpdater, updater, scale)


def rows(count):
    driven = torch.zeros(count, 3)
    parts = {"observation": driven, "action": driven[:, :2], ("next", "observation"): driven}
    return TensorDict(parts, [count])


@refused(
    (lambda: over(KNODE(Quadrotor()), KNODEUpdater, window=0.01), "multiple of the control tick"),
    (lambda: over(Dubins(), KNODEUpdater), "teaches a KNODE, got Dubins"),
    (lambda: over(Dubins(), RLSUpdater), "teaches a Calibrated model, got Dubins"),
    (lambda: over(Dubins(), StreamXUpdater), "teaches an Ensemble, got Dubins"),
    (lambda: beside([1.0]), "updater.scale=.*expected 2 positive numbers"),
    (lambda: beside([1.0, 0.0]), "updater.scale="),
    (lambda: beside(updater=lambda loss: loss), "updater.updater"),
    (
        lambda: pretrain_knode(KNODE(Quadrotor()).expand_(4), Quadrotor(), BOX, BOX),
        "before it is given to 4 missions",
    ),
    (
        lambda: pretrain_ensemble(ensemble(), Dubins(), BOX, BOX, samples=63, batch_size=64),
        "dynamics.pretrain.samples=63",
    ),
    (lambda: fit_ensemble(ensemble(), rows(1)), "transitions=1"),
    (lambda: collect(GymEnv("Pendulum-v1"), frames=0), "frames=0"),
)
def test_it_is_refused(make):
    make()
