"""What cannot be learnt, or from, is refused by name, in one line."""

from functools import partial

import torch
from harness import refused
from tensordict import TensorDict
from torchrl.envs import GymEnv

from afm_rl import learning
from afm_rl.dynamics import KNODE, Dubins, Ensemble, Quadrotor
from afm_rl.spaces.manifold import Manifold

BOX = torch.tensor([0.0, 0.0, -3.14]), torch.tensor([0.0, 0.0, 3.14])
GRADIENT = partial(learning.OnlineUpdater, optimizer=learning.ResetAdam)


def ensemble():
    return Ensemble(Manifold(3, angles=[2]), 2, features=[2], members=2, hidden=[4])


def over(model, kind, *settings, **more):
    return kind(learning.GaussianNLLLoss(model), *settings, **more)


def beside(scale=(1.0, 1.5), updater=GRADIENT):
    return over(ensemble(), learning.UnmatchedUpdater, updater, scale)


def rows(count):
    driven = torch.zeros(count, 3)
    parts = {"observation": driven, "action": driven[:, :2], ("next", "observation"): driven}
    return TensorDict(parts, [count])


@refused(
    (lambda: over(KNODE(Quadrotor()), learning.KNODEUpdater, window=0.01), "of the control tick"),
    (lambda: over(Dubins(), learning.KNODEUpdater), "teaches a KNODE, got Dubins"),
    (lambda: over(Dubins(), learning.RLSUpdater), "teaches a Calibrated model, got Dubins"),
    (lambda: over(Dubins(), learning.StreamXUpdater), "teaches an Ensemble, got Dubins"),
    (lambda: beside([1.0]), "updater.scale=.*expected 2 positive numbers"),
    (lambda: beside([1.0, 0.0]), "updater.scale="),
    (lambda: beside(updater=lambda loss: loss), "updater.updater"),
    (
        lambda: learning.pretrain_knode(KNODE(Quadrotor()).expand_(4), Quadrotor(), BOX, BOX),
        "before it is given to 4 missions",
    ),
    (
        lambda: learning.pretrain_ensemble(
            ensemble(), Dubins(), BOX, BOX, samples=63, batch_size=64
        ),
        "dynamics.pretrain.samples=63",
    ),
    (lambda: learning.fit_ensemble(ensemble(), rows(1)), "transitions=1"),
    (lambda: learning.collect(GymEnv("Pendulum-v1"), frames=0), "frames=0"),
)
def test_it_is_refused(make):
    make()
