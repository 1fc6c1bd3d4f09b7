"""The probabilistic ensemble."""

import copy
import math
from types import SimpleNamespace

import pytest
import torch
from harness import grown_apart
from torch import nn

from afm_rl.dynamics import ensemble as module
from afm_rl.dynamics.stacked import sparse_layer


def member_by_member(model, state, action):
    """Mean and raw log-variance of every member, with ordinary layers."""
    turn = state[..., [2]]
    inputs = torch.cat([turn.cos(), turn.sin(), action], -1)
    seen = model.running or SimpleNamespace(mean=model.input_mean, std=model.input_std)
    inputs = (inputs - seen.mean) / seen.std
    outputs = []
    for e in range(model.members):
        rows = inputs
        for k, (weight, bias) in enumerate(zip(model.weights, model.biases, strict=True)):
            rows = nn.functional.linear(rows, weight[e].T, bias[e, 0])
            if k < len(model.weights) - 1:
                normed = nn.functional.layer_norm(rows, rows.shape[-1:])
                rows = nn.functional.leaky_relu(normed if model.layer_norm else rows, 0.01)
        outputs.append(rows)
    return torch.stack(outputs, -2).chunk(2, -1)


@pytest.mark.parametrize("batch", [(), (5,), (2, 4), (0,)])
@pytest.mark.parametrize("hidden", [[16], [8, 8, 8]])
@pytest.mark.parametrize("normed", [{}, {"layer_norm": True, "running_count": 100}], ids=str)
def test_predictions_equal_those_of_single_networks(
    make_ensemble, transitions, batch, hidden, normed
):
    model = make_ensemble(hidden=hidden, **normed)
    model.normalise_(2 * torch.randn(200, 4) + 1, torch.randn(200, 3))
    model = model.double()
    state, action = transitions(*batch, dtype=torch.float64)
    mean, _ = member_by_member(model, state, action)
    found, log_variance = model.moments(state, action)
    assert found.shape == log_variance.shape == (*batch, 3, 3)
    torch.testing.assert_close(found, mean)
    change = mean.mean(-2) * model.target_std + model.target_mean
    expected = model.manifold.add(state, change)
    torch.testing.assert_close(model(state, action), expected)
    assert model.jacobian(state, action).shape == (*batch, 3, 2)


def test_log_variances_are_softly_bounded(make_ensemble, transitions):
    model = make_ensemble(log_variance=(-3.0, 0.5))
    state, action = transitions(500)
    _, raw = member_by_member(model, 100 * state, 1000 * action)
    assert raw.min() < -3 and raw.max() > 0.5  # or there would be nothing to bound
    _, bounded = model.moments(100 * state, 1000 * action)
    slack = math.log1p(math.exp(-3.5))  # what remains of the softness at the other end
    assert bounded.min() >= -3.0 and bounded.max() <= 0.5 + slack
    inside = (raw > -1.5) & (raw < -1.0)
    torch.testing.assert_close(bounded[inside], raw[inside], rtol=0, atol=0.5)


def test_the_noise_scale_is_that_of_the_mixture(make_ensemble, transitions):
    model = make_ensemble().double()
    state, action = transitions(6, dtype=torch.float64)
    mean, log_variance = model.moments(state, action)
    second = (log_variance.exp() + mean**2).mean(-2)
    expected = (second - mean.mean(-2) ** 2).sqrt() * model.target_std
    torch.testing.assert_close(model.noise_scale(state, action), expected)
    ahead, noise = model.forecast(state, action)
    torch.testing.assert_close(ahead, model(state, action))
    torch.testing.assert_close(noise, expected)


def test_chunks_change_nothing(make_ensemble, transitions, monkeypatch):
    model = make_ensemble().double()
    several = copy.deepcopy(model).expand_(4)
    state, action = transitions(4, 9, dtype=torch.float64)
    whole = model.moments(state, action), several.moments(state, action)
    for size in (1, 100, 400, 1000):  # below one row, some rows, a mission, several missions
        monkeypatch.setattr(module, "CHUNK", size)
        torch.testing.assert_close(model.moments(state, action), whole[0])
        torch.testing.assert_close(several.moments(state, action), whole[1])


def test_sampled_predictions_scatter_around_the_mean(make_ensemble, transitions):
    sampled = make_ensemble(propagation="sample", members=5).double()
    plain = make_ensemble(members=5).double()
    state, action = transitions(dtype=torch.float64)
    many = sampled(state.expand(20_000, -1), action.expand(20_000, -1))
    change = plain.manifold.difference(many, plain(state, action))
    _, log_variance = plain.moments(state, action)
    spread = (log_variance.exp().sum(-2).sqrt() / 5) * plain.target_std
    torch.testing.assert_close(change.std(0), spread, rtol=0.03, atol=0)
    assert (change.mean(0).abs() < 0.03 * spread).all()


TOLERANCE = 0.02  # standard deviations of the state change: two roundings to 8 bits per layer


def agree(model, state, action):
    """Is the prediction in bfloat16 that of the present parameters, but for the rounding?"""
    single = copy.deepcopy(model)  # before either draws a sample
    single.precision = "float32"
    with torch.no_grad():
        found, expected = model(state, action), single(state, action)
        assert torch.equal(model.moments(state, action)[0], single.moments(state, action)[0])
    error = model.manifold.difference(found, expected) / model.target_std
    return found.dtype is expected.dtype and 0.0 < float(error.abs().max()) < TOLERANCE


@pytest.mark.parametrize("propagation", ["mean", "sample"])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_bfloat16_is_close_whatever_becomes_of_the_parameters(
    make_ensemble, transitions, propagation, layer_norm
):
    settings = {"propagation": propagation, "layer_norm": layer_norm, "hidden": [64, 64, 64]}
    model = make_ensemble(precision="bfloat16", **settings)
    assert agree(model, *transitions(100)) and agree(model.double(), *transitions(100))
    grown_apart(model.float().expand_(4))
    state, action = transitions(4, 20)
    assert agree(model, state, action)
    model(state, action).sum().backward()
    assert all(weight.grad is not None for weight in model.weights)  # gradients are not rounded
    torch.optim.SGD(model.parameters(), lr=0.1).step()
    assert agree(model, state, action)
    keep = torch.tensor([2, 0])
    model.select_(keep)
    assert agree(model, state[keep], action[keep])
    model.load_state_dict(grown_apart(copy.deepcopy(model)).state_dict())
    assert agree(model, state[keep], action[keep])


def test_training_members_see_samples_of_their_own(make_ensemble, transitions):
    model = make_ensemble().double()
    state, action = transitions(3, 8, dtype=torch.float64)
    mean, log_variance = model.member_moments(model.network_rows(state, action))
    for e in range(3):
        whole = model.moments(state[e], action[e])
        torch.testing.assert_close(mean[e], whole[0][:, e])
        torch.testing.assert_close(log_variance[e], whole[1][:, e])


def test_statistics_are_those_of_the_data(make_ensemble):
    model = make_ensemble()
    inputs, targets = 3 + 2 * torch.randn(50, 4), torch.randn(50, 3)
    targets[:, 1] = 7.0  # constant: must not divide by zero
    model.normalise_(inputs, targets)
    torch.testing.assert_close(model.input_mean, inputs.mean(0))
    torch.testing.assert_close(model.input_std, inputs.std(0))
    standard = model.standardise(targets)
    assert standard.isfinite().all()
    torch.testing.assert_close(standard[:, [0, 2]].std(0), torch.ones(2))


def test_initial_weights_are_within_the_bounds_of_linear_layers(make_ensemble):
    one = make_ensemble(seed=1)
    assert one.weights[1].abs().max() <= 0.25  # 1 / sqrt(16)
    assert one.weights[1].abs().max() > 0.24
    assert not torch.equal(one.weights[0][0], one.weights[0][1])  # members differ


@pytest.mark.parametrize(("fan_in", "kept"), [(3, 1), (10, 1), (50, 5), (200, 20)])
def test_each_unit_keeps_a_tenth_of_its_inputs(fan_in, kept):
    weight, bias = sparse_layer(4, fan_in, 300, torch.Generator().manual_seed(0))
    assert weight.shape == (4, fan_in, 300) and bias.shape == (4, 1, 300)
    assert ((weight != 0).sum(1) == kept).all() and not bias.any()
    assert 0.95 * fan_in**-0.5 < weight.abs().max() <= fan_in**-0.5
    used = (weight != 0).double().mean((0, 2))  # every input by some units
    torch.testing.assert_close(used, torch.full_like(used, kept / fan_in), rtol=0.35, atol=0.01)
