"""Ensembles of which every mission has its own."""

import copy

import pytest
import torch
from test_knode import car_rate

from afm_rl.dynamics import KNODE, Calibrated, Dubins
from afm_rl.errors import ConfigurationError


@pytest.fixture
def missions(make_ensemble):
    """Four missions whose ensembles have grown apart."""
    model = make_ensemble().double().expand_(4)
    generator = torch.Generator().manual_seed(0)
    for parameter in model.parameters():
        noise = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
        parameter.data += 0.2 * noise
    return model


def single(missions, model, index):
    alone = copy.deepcopy(model)
    for target, source in zip(alone.parameters(), missions.parameters(), strict=True):
        target.data = source.data[index].clone()
    return alone


def test_a_batch_of_missions_equals_single_ones(missions, make_ensemble, transitions):
    state, action = transitions(4, 5, dtype=torch.float64)
    ahead, noise = missions.forecast(state, action)
    for index in range(4):
        alone = single(missions, make_ensemble().double(), index)
        expected = alone.forecast(state[index], action[index])
        torch.testing.assert_close((ahead[index], noise[index]), expected)
        torch.testing.assert_close(missions(state, action)[index], expected[0])


def test_gradients_stay_with_their_mission(missions, transitions):
    state, action = transitions(4, dtype=torch.float64)
    missions(state, action)[1].sum().backward()
    for parameter in missions.parameters():
        if parameter.grad is not None:
            assert parameter.grad[[0, 2, 3]].abs().sum() == 0


MODELS = {
    "ensemble": lambda ensemble: ensemble(),
    "with running statistics": lambda ensemble: ensemble(layer_norm=True, running_count=100),
    "calibrated": lambda _: Calibrated(Dubins(), torch.ones(2)),
    "KNODE": lambda _: KNODE(Dubins(), rate=car_rate, units=8).push_(),
}


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_missions_have_models_of_their_own_and_leave(make, make_ensemble, transitions):
    model = make(make_ensemble).double()
    state, action = transitions(4, 5, dtype=torch.float64)
    shared = model(state, action)
    assert model.select_(torch.tensor([1])) is model and model.lead == ()
    assert torch.equal(model(state, action), shared)
    held = [*map(id, model.parameters())]  # by optimisers
    assert model.expand_(4) is model and model.lead == (4,)
    assert [*map(id, model.parameters())] == held
    torch.testing.assert_close(model(state, action), shared)
    for part in filter(torch.is_floating_point, (*model.parameters(), *model.buffers())):
        part.data += 0.1 * torch.rand_like(part)
    before = model(state, action)
    assert not torch.allclose(before, shared)
    for index in map(torch.tensor, ([2, 0], [True, False, True, False], [3])):
        twin = copy.deepcopy(model)
        assert twin.select_(index) is twin
        torch.testing.assert_close(twin(state[index], action[index]), before[index])
    with pytest.raises(ConfigurationError, match=r"holds \(4,\) missions, got .* \(3, 5\)"):
        model(state[:3], action[:3])
    with pytest.raises(ConfigurationError, match=r"already expanded to \(4,\)"):
        model.expand_(2)
