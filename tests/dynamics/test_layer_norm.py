"""Ensembles with layer norms, sparse initial weights and running statistics."""

import copy

import pytest
import torch
from torch import nn

from afm_rl.dynamics.stacked import SLOPE, sparse_layer

HIDDEN = [[16], [8, 8, 8]]


@pytest.fixture
def make(make_ensemble):
    def build(**settings):
        model = make_ensemble(layer_norm=True, init="sparse", running_count=100, **settings)
        model.normalise_(2 * torch.randn(200, 4) + 1, torch.randn(200, 3))
        return model.double()

    return build


def apart(model, missions):
    """Give missions parameters and statistics that differ."""
    model.expand_(missions)
    for parameter in model.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    scale = 1 + torch.arange(missions).reshape(-1, 1, 1)
    model.running.update_(scale * torch.randn(missions, 60, 4, dtype=torch.float64))
    return model


@pytest.mark.parametrize("hidden", HIDDEN)
def test_outputs_equal_those_of_ordinary_layers(make, transitions, hidden):
    model = make(hidden=hidden)
    state, action = transitions(6, dtype=torch.float64)
    rows = (model.inputs(state, action) - model.running.mean) / model.running.std
    out, _ = model.moments(state, action)
    for e in range(model.members):
        layers = []
        for weight, bias in zip(model.weights, model.biases, strict=True):
            linear = nn.Linear(*weight.shape[1:], dtype=torch.float64)
            linear.weight.data, linear.bias.data = weight.data[e].T, bias.data[e, 0]
            norm = nn.LayerNorm(weight.shape[-1], elementwise_affine=False)
            layers += [linear, norm, nn.LeakyReLU(SLOPE)]
        expected = nn.Sequential(*layers[:-2])(rows)[:, :3]
        torch.testing.assert_close(out[:, e], expected)


def test_missions_have_statistics_of_their_own(make, transitions):
    shared = make()
    model = apart(copy.deepcopy(shared), 4)
    state, action = transitions(4, 5, dtype=torch.float64)
    before = model(state, action)
    for index in range(4):
        alone = copy.deepcopy(shared)
        for target, source in zip(alone.parameters(), model.parameters(), strict=True):
            target.data = source.data[index].clone()
        alone.running.load_state_dict({k: v[index] for k, v in model.running.state_dict().items()})
        torch.testing.assert_close(alone(state[index], action[index]), before[index])


def test_running_statistics_go_on_from_pre_training(make_ensemble, transitions):
    model = make_ensemble(running_count=100)
    data = 2 * torch.randn(400, 4) + 1
    model.normalise_(data, torch.randn(400, 3))
    assert model.running.count == 100  # at most so many
    torch.testing.assert_close(model.running.mean, data.mean(0))
    torch.testing.assert_close(model.running.std, data.std(0))
    state, action = transitions(1)
    model.observe_(state, action)
    expected = data.mean(0) + (model.inputs(state, action)[0] - data.mean(0)) / 101
    torch.testing.assert_close(model.running.mean, expected)
    model.normalise_(data[:20], torch.randn(20, 3))
    assert model.running.count == 20


def test_statistics_stay_without_the_switch(make_ensemble, transitions):
    model = make_ensemble()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    model.observe_(*transitions(5))
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(("fan_in", "kept"), [(3, 1), (10, 1), (50, 5), (200, 20)])
def test_each_unit_keeps_a_tenth_of_its_inputs(fan_in, kept):
    weight, bias = sparse_layer(4, fan_in, 300, torch.Generator().manual_seed(0))
    assert weight.shape == (4, fan_in, 300) and bias.shape == (4, 1, 300)
    assert ((weight != 0).sum(1) == kept).all() and not bias.any()
    assert 0.95 * fan_in**-0.5 < weight.abs().max() <= fan_in**-0.5
    used = (weight != 0).double().mean((0, 2))  # every input by some units
    torch.testing.assert_close(used, torch.full_like(used, kept / fan_in), rtol=0.35, atol=0.01)
