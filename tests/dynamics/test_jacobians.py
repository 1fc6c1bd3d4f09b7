"""Closed-form Jacobians against finite differences and automatic ones."""

import pytest
import torch

from afm_rl.dynamics import Dubins, Oracle


def finite_differences(model, state, action, step=1e-6):
    columns = []
    for axis in torch.eye(2, dtype=state.dtype):
        ahead, behind = (model(state, action + sign * step * axis) for sign in (1, -1))
        columns.append(model.manifold.difference(ahead, behind) / (2 * step))
    return torch.stack(columns, -1)


@pytest.fixture(params=["dubins", "ensemble", "oracle", "oracle of an ensemble"])
def model(request, make_ensemble, gains):
    told = gains.encode({"v_gain": -1.7, "omega_gain": 0.3}).double()
    if request.param == "dubins":
        return Dubins()
    if request.param == "ensemble":
        return make_ensemble().double()
    oracle = Oracle(Dubins() if request.param == "oracle" else make_ensemble().double(), gains)
    oracle.set_regime(told)
    return oracle


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_jacobians_match_finite_differences(model, transitions, batch):
    state, action = transitions(*batch, dtype=torch.float64)
    jacobian = model.jacobian(state, action)
    assert jacobian.shape == (*batch, 3, 2)
    torch.testing.assert_close(jacobian, finite_differences(model, state, action))


def test_missions_have_jacobians_of_their_own(make_ensemble, transitions):
    model = make_ensemble().double().expand_(3)
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    state, action = transitions(3, 4, dtype=torch.float64)
    jacobian = model.jacobian(state, action)
    torch.testing.assert_close(jacobian, finite_differences(model, state, action))
    assert not torch.allclose(jacobian[0], model.jacobian(state[[1, 1, 1]], action[[1, 1, 1]])[0])


def test_oracles_of_missions_have_jacobians_of_their_own(gains, transitions):
    oracle = Oracle(Dubins(), gains)
    oracle.set_regime(torch.tensor([[2.0, 1.0], [1.0, -1.0]]).double())
    state, action = transitions(2, 5, dtype=torch.float64)
    jacobian = oracle.jacobian(state, action)
    torch.testing.assert_close(jacobian, finite_differences(oracle, state, action))
