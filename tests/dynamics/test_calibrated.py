"""A model behind a calibration of its action."""

import pytest
import torch

from afm_rl.dynamics import Calibrated, Dubins

HALF = torch.tensor([1.0, 1.5])


def calibrated(base=None, missions=None, offset=0.01):
    """Make a calibration far from the identity, another one for each mission."""
    base = base or Dubins()
    model = Calibrated(base, torch.linspace(0.5, 1.5, base.action_size)).double()
    if missions is not None:
        model.expand_(missions)
    draw = torch.Generator().manual_seed(1)

    def normal(*shape):
        return torch.randn((*model.lead, *shape), generator=draw, dtype=torch.float64)

    size = base.action_size
    matrix, bias = torch.eye(size) + 0.3 * normal(size, size), 0.1 * normal(size)
    offset = offset * normal(base.manifold.tangent_size)
    model.calibrate_(matrix=matrix, bias=bias, offset=offset)
    return model


def test_missions_without_a_calibration_predict_as_the_model_to_the_bit(transitions):
    base, model = Dubins(), Calibrated(Dubins(), HALF).expand_(3)
    matrix, offset = model.matrix.clone(), model.offset.clone()
    matrix[1], offset[1] = 2.0, 0.1
    model.calibrate_(matrix=matrix, offset=offset)
    state, action = transitions(3, 50)
    given, plans = (state, action), (state[:, 0], action.reshape(3, 5, 10, 2))
    for found, nominal in (
        (model(*given), base(*given)),
        (model.jacobian(*given), base.jacobian(*given)),
        (model.moments(*given)[0], base.moments(*given)[0]),
        (model.rollout(*plans), base.rollout(*plans)),
    ):
        assert (found == nominal).flatten(1).all(-1).tolist() == [True, False, True]


@pytest.mark.parametrize("missions", [None, 4])
def test_what_it_predicts(transitions, missions):
    model = calibrated(missions=missions)
    state, action = transitions(4, 7, dtype=torch.float64)

    def wide(part):
        lead = model.lead
        return part.reshape(*lead, *(1,) * (2 - len(lead)), *part.shape[len(lead) :])

    unit = action / model.half_range
    moved = (wide(model.matrix) @ unit.unsqueeze(-1)).squeeze(-1) + wide(model.bias)
    moved = moved * model.half_range
    expected = model.manifold.add(model.model(state, moved), wide(model.offset))
    torch.testing.assert_close(model(state, action), expected)
    ahead, noise = model.forecast(state, action)
    torch.testing.assert_close(ahead, expected)
    assert torch.equal(noise, model.noise_scale(state, action))
    mean, log_variance = model.moments(state, action)
    change = model.standardise(model.manifold.difference(expected, state))
    torch.testing.assert_close(mean.squeeze(-2), change)
    assert not log_variance.any()
