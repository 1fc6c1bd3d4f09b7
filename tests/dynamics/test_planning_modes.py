"""Faster predictions for the planner: one member per candidate, and bfloat16."""

import copy

import pytest
import torch
from harness import grown_apart
from tensordict import TensorDict

from afm_rl.dynamics import ensemble as module
from afm_rl.learning import GaussianNLLLoss, OnlineUpdater, ResetAdam

TOLERANCE = 0.02  # standard deviations of the state change: two roundings to 8 bits per layer


def by_hand(model, state, action):
    """Candidate i through member i modulo E, from the moments of all members."""
    mean, _ = model.moments(state, action)
    member = torch.arange(state.shape[-2]) % model.members
    index = member[:, None, None].expand(*mean.shape[:-2], 1, mean.shape[-1])
    change = mean.gather(-2, index).squeeze(-2)
    return model.manifold.add(state, change * model.target_std + model.target_mean)


@pytest.mark.parametrize("batch", [(3,), (9,), (10,), (4, 7), (2, 3, 8), (0, 6)], ids=str)
@pytest.mark.parametrize("lead", [(), (4,)], ids=str)
@pytest.mark.parametrize("size", [1, 100, 400, 2**18])
def test_each_candidate_goes_through_one_member_of_its_mission(
    make_ensemble, transitions, batch, lead, size, monkeypatch
):
    monkeypatch.setattr(module, "CHUNK", size)
    model = make_ensemble(propagation="member").double()
    model = grown_apart(model.expand_(*lead) if lead else model)
    state, action = transitions(*lead, *batch, dtype=torch.float64)
    torch.testing.assert_close(model(state, action), by_hand(model, state, action))


@pytest.mark.parametrize("missions, batch", [(None, ()), (None, (2,)), (4, (4,)), (4, (4, 2))])
def test_too_few_candidates_get_the_mean(make_ensemble, transitions, missions, batch):
    model, plain = make_ensemble(propagation="member"), make_ensemble()
    if missions is not None:
        model.expand_(missions), plain.expand_(missions)
    state, action = transitions(*batch)
    assert torch.equal(model(state, action), plain(state, action))


def test_only_the_prediction_knows_the_modes(make_ensemble, transitions):
    fast = make_ensemble(propagation="member", precision="bfloat16", hidden=[16, 16, 16])
    plain = make_ensemble(hidden=[16, 16, 16])
    state, action = transitions(7)
    with torch.no_grad():
        for name in ("moments", "forecast", "jacobian"):
            pair = (getattr(model, name)(state, action) for model in (fast, plain))
            torch.testing.assert_close(*pair, rtol=0, atol=0)


@pytest.fixture
def fast(make_ensemble):
    """An ensemble that plans in bfloat16, with two hidden products."""
    return make_ensemble(precision="bfloat16", hidden=[32, 32, 32])


def as_single(model):
    """The same ensemble in float32."""
    twin = copy.deepcopy(model)
    twin.precision = "float32"
    return twin


def agree(model, state, action):
    """Is the prediction that of the present parameters, but for the rounding?"""
    single = as_single(model)  # before either draws a sample
    with torch.no_grad():
        found, expected = model(state, action), single(state, action)
    error = model.manifold.difference(found, expected) / model.target_std
    return found.dtype is expected.dtype and 0.0 < float(error.abs().max()) < TOLERANCE


@pytest.mark.parametrize("propagation", ["mean", "member", "sample"])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_bfloat16_is_close(make_ensemble, transitions, propagation, layer_norm):
    settings = {"propagation": propagation, "layer_norm": layer_norm, "hidden": [64, 64, 64]}
    model = make_ensemble(precision="bfloat16", **settings)
    assert agree(model, *transitions(100)) and agree(model.double(), *transitions(100))
    assert agree(model.float().expand_(4), *transitions(4, 30))


def test_gradients_are_not_rounded(fast, transitions):
    state, action = transitions(6)
    assert torch.equal(fast(state, action), as_single(fast)(state, action))
    fast(state, action).sum().backward()
    assert all(weight.grad is not None for weight in fast.weights)


def test_the_copies_follow_the_parameters(fast, transitions):
    state, action = transitions(4, 20)
    assert agree(fast, state, action)
    grown_apart(fast.expand_(4))
    assert agree(fast, state, action)
    updater = OnlineUpdater(GaussianNLLLoss(fast), lambda p: ResetAdam(p, lr=0.1))
    before = fast(state, action)
    td = TensorDict({"observation": state[:, 0], "action": action[:, 0]}, [4])
    updater(td.set(("next", "observation"), state[:, 1]))
    assert not torch.allclose(fast(state, action), before, atol=1e-3)
    assert agree(fast, state, action)
    keep = torch.tensor([2, 0])
    fast.select_(keep)
    assert agree(fast, state[keep], action[keep])
    other = grown_apart(copy.deepcopy(fast))
    fast.load_state_dict(other.state_dict())
    assert agree(fast, state[keep], action[keep])
    with torch.no_grad():
        assert torch.equal(fast(state[keep], action[keep]), other(state[keep], action[keep]))
