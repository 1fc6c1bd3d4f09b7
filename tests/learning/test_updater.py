"""Every learner, per mission; frozen models; the oracle; the verdict of a guard."""

import math
from functools import partial

import pytest
import torch
from harness import HIGH, loss_by_row, transition
from tensordict import TensorDict
from test_knode_updater import stream

from afm_rl.dynamics import KNODE, Calibrated, Dubins, Oracle, Quadrotor
from afm_rl.learning import (
    GaussianNLLLoss,
    KNODEUpdater,
    OnlineUpdater,
    OracleUpdater,
    ResetAdam,
    RLSUpdater,
    StreamXUpdater,
    UnmatchedUpdater,
    Updater,
)

GRADIENT = partial(OnlineUpdater, optimizer=partial(ResetAdam, lr=1e-2))


def plain(new):
    return new().double()


def normed(new):
    return new(init="sparse", layer_norm=True, running_count=1000).double()


LEARNERS = {
    "Adam, new at each step": (plain, GRADIENT),
    "gradient descent": (plain, partial(OnlineUpdater, optimizer=torch.optim.SGD)),
    "stream-x": (normed, StreamXUpdater),
    "stream-x on the loss": (normed, partial(StreamXUpdater, form="loss")),
    "beside AFM": (plain, partial(UnmatchedUpdater, updater=GRADIENT, scale=HIGH, gate=0.1)),
    "least squares": (
        lambda _: Calibrated(Dubins(), HIGH).double(),
        partial(RLSUpdater, part="matched"),
    ),
    "networks": (lambda _: KNODE(Quadrotor()), partial(KNODEUpdater, begin=0.0, epochs=5)),
}


def slides():
    """Return six ticks of four ground robots whose motors are reversed, and that slide sideways."""
    draw = torch.Generator().manual_seed(0)
    for _ in range(6):
        state, action = (
            2 * torch.rand(4, size, generator=draw, dtype=torch.float64) - 1 for size in (3, 2)
        )
        side = torch.stack([-state[:, 2].sin(), state[:, 2].cos(), torch.zeros(4)], -1)
        yield transition(state, action, Dubins()(state, -action) + 0.3 * side)


@pytest.fixture(params=LEARNERS)
def learner(request, make_ensemble):
    """Make a model of some missions and its updater; beside it are six ticks of four missions."""

    new, updater = LEARNERS[request.param]

    def make(missions):
        model = new(make_ensemble).expand_(missions)
        return model, updater(GaussianNLLLoss(model))

    drives = stream(6, torch.tensor([1.5, 0.75, 2.0, 0.5]))
    return make, drives if request.param == "networks" else list(slides())


def learnt(model, row):
    """Return all that a mission has learnt as one vector."""
    parts = [*model.parameters(), *(getattr(model, "running", None) or torch.nn.Module()).buffers()]
    if isinstance(model, Calibrated):
        parts = [model.matrix, model.bias, model.offset]
    parts = model.networks if isinstance(model, KNODE) else parts
    return torch.cat([part.detach()[row].flatten() for part in parts])


def near(dtype):
    return {"rtol": 1e-7, "atol": 1e-9} if dtype is torch.float64 else {"rtol": 1e-3, "atol": 1e-4}


def test_missions_learn_as_if_they_were_alone_and_may_leave(learner):
    make, ticks = learner
    (model, updater), alone, left = make(4), [make(1) for _ in range(4)], torch.arange(4)
    begin = learnt(model, 1)
    for k, td in enumerate(ticks):
        if k == 3:
            left = torch.tensor([3, 1])
            model.select_(left)
        before = updater.loss(td[left])["loss_nll"].detach()
        loss = updater(td[left])["loss"]
        assert not loss.requires_grad
        torch.testing.assert_close(loss, before)  # it is measured before learning
        for row, index in enumerate(left):
            torch.testing.assert_close(alone[index][1](td[[index]])["loss"][0], loss[row])
    for row, index in enumerate(left):
        found = learnt(model, row)
        torch.testing.assert_close(found, learnt(alone[index][0], 0), **near(found.dtype))
    assert updater.learns and not torch.equal(learnt(model, 1), begin)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("observation", math.nan),
        ("action", -math.inf),
        (("next", "observation"), math.inf),
        (("next", "observation"), 1e30),
    ],
    ids=str,
)
def test_faulty_transitions_are_refused_and_counted(learner, key, value):
    make, ticks = learner
    (model, updater), (twin, other) = make(4), make(4)
    for k, td in enumerate(ticks):
        other(td)
        shown, before = td.clone(), learnt(model, 1)
        if k == 4:
            shown[key][1] = value
        loss = updater(shown)["loss"]
        assert loss.isfinite().tolist() == [True, k != 4, True, True]
        assert k != 4 or torch.equal(learnt(model, 1), before)
    assert updater.refused == 1 and learnt(model, 1).isfinite().all()
    for index in (0, 2, 3):  # the others learn as ever
        found = learnt(model, index)
        torch.testing.assert_close(found, learnt(twin, index), **near(found.dtype))


def test_a_frozen_model_is_measured_only(make_ensemble, transitions):
    model = make_ensemble()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    state, action = transitions(5)
    td = transition(state, action, Dubins()(state, action))
    updater = Updater(GaussianNLLLoss(model))
    updater.start(td)
    loss = updater(td)["loss"]
    expected = loss_by_row(model)(td)["loss_nll"]
    torch.testing.assert_close(loss, expected)
    assert not updater.learns and not loss.requires_grad
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])


def test_the_oracle_is_told_the_regime_of_the_next_action(gains, transitions):
    oracle = Oracle(Dubins(), gains)
    updater = OracleUpdater(GaussianNLLLoss(oracle), regime_key=["hidden", "regime"])
    now, later = gains.sample((2, 3), torch.Generator().manual_seed(0))
    state, action = transitions(3)
    td = TensorDict({"observation": state, "action": action, "hidden": {"regime": now}}, [3])
    updater.start(td)
    assert updater.oracle is oracle and torch.equal(oracle.parameters_now, now)
    td["next", "observation"] = Dubins()(state, action * now)
    td["next", "hidden", "regime"] = later
    loss = updater(td)["loss"]  # measured with what held during the transition
    torch.testing.assert_close(loss, torch.zeros(3), rtol=0, atol=1e-6)
    assert torch.equal(oracle.parameters_now, later)


def test_a_guard_that_is_there_says_what_is_stale(make_ensemble, transitions):
    updater = OnlineUpdater(GaussianNLLLoss(make_ensemble()), torch.optim.Adam)
    state, action = transitions(3)
    fresh, stale = (transition(state, action, after) for after in (state + 0.1, state))
    assert updater(fresh)["loss"].isfinite().all() and updater(stale)["loss"].isnan().all()
    for td in (fresh, stale):  # the guard's verdict, whatever the readings look like
        td["next", "guard", "sound"] = torch.tensor([True, False, True])
        assert updater(td)["loss"].isfinite().tolist() == [True, False, True]
    stale["next", "observation"][2] = torch.nan
    assert updater(stale)["loss"].isfinite().tolist() == [True, False, False]
    assert updater.refused == 3 + 1 + 1 + 2
