"""A KNODE's first network, before any flight."""

import torch

from afm_rl.dynamics import KNODE, Oracle, Quadrotor
from afm_rl.learning.knode_fit import pretrain_knode
from afm_rl.regimes import MassFactor

LEVEL = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
SPREAD = torch.tensor([0.8] * 6 + [0.05] * 3 + [0.0] + [0.5] * 3)
STATES = LEVEL - SPREAD, LEVEL + SPREAD
ACTIONS = torch.tensor([0.2, 0.0, 0.0, 0.0]), torch.tensor([0.4, 0.0, 0.0, 0.0])


def train(model, **settings):
    teacher = Oracle(Quadrotor(), MassFactor())
    teacher.set_regime(torch.tensor([1.2]))
    settings = {"flights": 20, "ticks": 4, "epochs": 60, **settings}
    return pretrain_knode(model, teacher, STATES, ACTIONS, **settings)


def test_another_mass_is_learnt_and_the_same_each_time():
    model, twin, other = (KNODE(Quadrotor()) for _ in range(3))
    error = train(model, epochs=2)
    assert error == train(twin, epochs=2) != train(other, epochs=2, seed=1)
    assert torch.equal(model.networks.inner, twin.networks.inner)
    assert not model.networks.inner[1:].any()
    assert train(KNODE(Quadrotor())) < 0.5 * error


def test_flights_may_be_under_regimes_of_their_own():
    settings = {"flights": 20, "ticks": 4, "epochs": 60}
    few, many = (KNODE(Quadrotor()) for _ in range(2))
    heavy = MassFactor([1.19, 1.21])
    error = pretrain_knode(few, Quadrotor(), STATES, ACTIONS, regime=heavy, **settings)
    assert error < 0.5 * train(KNODE(Quadrotor()), epochs=1)  # as with a heavy teacher
    anything = MassFactor([0.5, 1.5])
    assert error < pretrain_knode(many, Quadrotor(), STATES, ACTIONS, regime=anything, **settings)
