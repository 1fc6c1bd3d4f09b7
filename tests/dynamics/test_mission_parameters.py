"""Models of which every mission has its own."""

import copy

import pytest
import torch
from test_knode import car_rate

from afm_rl.dynamics import KNODE, Calibrated, Dubins
from afm_rl.errors import ConfigurationError

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
    shared = model.forecast(state, action)
    assert model.select_(torch.tensor([1])) is model and model.lead == ()
    torch.testing.assert_close(model.forecast(state, action), shared, rtol=0, atol=0)
    held = [*map(id, model.parameters())]  # by optimisers
    assert model.expand_(4) is model and model.lead == (4,)
    assert [*map(id, model.parameters())] == held
    torch.testing.assert_close(model.forecast(state, action), shared)
    for part in filter(torch.is_floating_point, (*model.parameters(), *model.buffers())):
        part.data += 0.1 * torch.rand_like(part)
    before, noise = model.forecast(state, action)
    assert not torch.allclose(before, shared[0])
    for index in map(torch.tensor, ([2, 0], [True, False, True, False], [3])):
        twin = copy.deepcopy(model)
        assert twin.select_(index) is twin
        found = twin.forecast(state[index], action[index])
        torch.testing.assert_close(found, (before[index], noise[index]))
    with pytest.raises(ConfigurationError, match=r"holds \(4,\) missions, got .* \(3, 5\)"):
        model(state[:3], action[:3])
    with pytest.raises(ConfigurationError, match=r"already expanded to \(4,\)"):
        model.expand_(2)
