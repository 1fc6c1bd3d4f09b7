"""Updaters that do not learn, and what learners learn from."""

import torch
from harness import loss_by_row, transition
from tensordict import TensorDict

from afm_rl.dynamics import Dubins, Oracle
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, OracleUpdater, Updater


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
