"""Ensembles of which every mission has its own."""

import copy

import pytest
import torch

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


def test_expansion_copies_the_shared_model(make_ensemble, transitions):
    model = make_ensemble().double()
    shared = copy.deepcopy(model)
    identities = [id(parameter) for parameter in model.parameters()]
    assert model.lead == () and model.expand_(4) is model and model.lead == (4,)
    assert [id(parameter) for parameter in model.parameters()] == identities  # optimisers hold them
    state, action = transitions(4, 6, dtype=torch.float64)
    torch.testing.assert_close(model(state, action), shared(state, action))
    model.weights[0].data[1] += 1.0  # memory of their own, too
    torch.testing.assert_close(model(state, action)[0], shared(state, action)[0])
    assert not torch.allclose(model(state, action)[1], shared(state, action)[1])


def test_a_batch_of_missions_equals_single_ones(missions, make_ensemble, transitions):
    state, action = transitions(4, 5, dtype=torch.float64)
    ahead, noise = missions.forecast(state, action)
    for index in range(4):
        alone = single(missions, make_ensemble().double(), index)
        expected = alone.forecast(state[index], action[index])
        torch.testing.assert_close((ahead[index], noise[index]), expected)
        torch.testing.assert_close(missions(state, action)[index], expected[0])


@pytest.mark.parametrize("index", [[2, 0], [True, False, True, False], [3]], ids=str)
def test_selection_keeps_the_right_missions(missions, transitions, index):
    index = torch.tensor(index)
    state, action = transitions(4, 5, dtype=torch.float64)
    before = missions(state, action)
    missions(state, action).sum().backward()
    assert missions.select_(index) is missions
    torch.testing.assert_close(missions(state[index], action[index]), before[index])
    assert all(parameter.grad is None for parameter in missions.parameters())


def test_a_shared_model_has_no_missions_to_select(make_ensemble, transitions):
    model = make_ensemble()
    state, action = transitions(4)
    before = model(state, action)
    assert torch.equal(model.select_(torch.tensor([1]))(state, action), before)


def test_missions_that_do_not_fit_are_refused(missions, transitions):
    state, action = transitions(3, 5, dtype=torch.float64)
    with pytest.raises(
        ConfigurationError, match=r"holds \(4,\) missions, got a batch of shape \(3, 5\)"
    ):
        missions(state, action)
    with pytest.raises(ConfigurationError, match=r"already expanded to \(4,\)"):
        missions.expand_(2)


def test_gradients_stay_with_their_mission(missions, transitions):
    state, action = transitions(4, dtype=torch.float64)
    missions(state, action)[1].sum().backward()
    for parameter in missions.parameters():
        if parameter.grad is not None:
            assert parameter.grad[[0, 2, 3]].abs().sum() == 0
