"""The quadratic cost of following a reference."""

import math

import pytest
import torch

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.planning import MPPI, PlanningEnv, TrackingCost

WEIGHTS, ACTION_WEIGHTS = [1.0, 2.0, 0.5], [0.3, 0.1]


@pytest.fixture
def cost():
    return TrackingCost(WEIGHTS, ACTION_WEIGHTS, [1, 0], rest=[9.0, 9.0, 0.7], angles=[2])


def test_it_is_the_sum_it_says(cost):
    state, action, reference = torch.randn(4, 3), torch.randn(4, 2), torch.randn(4, 2)
    goal = torch.stack([reference[:, 1], reference[:, 0], torch.full((4,), 0.7)], -1)
    expected = ((state - goal) ** 2 * torch.tensor(WEIGHTS)).sum(-1)
    expected = expected + (action**2 * torch.tensor(ACTION_WEIGHTS)).sum(-1)
    torch.testing.assert_close(cost(torch.zeros(4, 3), action, state, reference), expected)


def test_angles_take_the_shorter_way(cost):
    state, still = torch.tensor([0.0, 0.0, 0.7 + 2 * math.pi - 0.2]), torch.zeros(2)
    found = cost(state, still, state, torch.zeros(2))
    torch.testing.assert_close(found, torch.tensor(0.5 * 0.2**2))
    assert state[2] > 6  # it is left alone


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)], ids=str)
@pytest.mark.parametrize("rows", [1, 5])
def test_the_expansion_is_exact(cost, batch, rows, dtype):
    states, actions = torch.randn(*batch, 5, 3).to(dtype), torch.randn(*batch, 4, 2).to(dtype)
    reference = torch.randn(*batch, rows, 2)
    state_hessian, state_slope, action_hessian, action_slope = cost.quadratic(
        states, actions, reference
    )
    assert state_hessian.shape == (*batch, 5, 3, 3) and state_slope.shape == (*batch, 5, 3)
    assert action_hessian.shape == (*batch, 4, 2, 2) and action_slope.shape == (*batch, 4, 2)
    dx, du = 0.1 * torch.randn_like(states), 0.1 * torch.randn_like(actions)

    def total(x, u):
        off = cost(x, torch.zeros_like(x[..., :2]), x, reference).sum(-1)
        still = cost.rest.to(x).expand(*u.shape[:-1], 3)
        return off + cost(still, u, still, torch.zeros(*u.shape[:-1], 2)).sum(-1)

    def second(hessian, slope, d):
        curved = (d.unsqueeze(-2) @ hessian @ d.unsqueeze(-1)).squeeze(-1) / 2
        return (curved + (slope * d).sum(-1, keepdim=True)).flatten(-2).sum(-1)

    expected = total(states + dx, actions + du) - total(states, actions)
    found = second(state_hessian, state_slope, dx) + second(action_hessian, action_slope, du)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_planners_that_sample_can_use_it_with_a_held_reference(box):
    cost = TrackingCost([1.0, 1.0, 0.0], [0.01, 0.01], [0, 1])
    planner = MPPI(PlanningEnv(Dubins(), cost, *box), horizon=4, candidates=32)
    td = planner.env.reset()
    td["reference"] = torch.tensor([2.0, 0.0])
    assert float(planner(td.set(("mppi", "mean"), torch.zeros(4, 2)))["action"][0]) > 0.3


def test_sizes_that_do_not_fit_are_told(cost):
    with pytest.raises(ConfigurationError, match="3 state coordinates and 2 .* are 4 and 2"):
        cost.quadratic(torch.zeros(3, 4), torch.zeros(2, 2), torch.zeros(1, 2))


def test_without_a_reference_all_coordinates_have_targets_of_their_own():
    cost = TrackingCost([1.0, 2.0], [0.0], coordinates=[], rest=[0.0, 1.0], in_keys=[])
    state = torch.tensor([[3.0, 3.0], [0.0, 1.0]])
    assert cost(state, torch.ones(2, 1), state).tolist() == [17.0, 0.0]
    assert cost.quadratic(state, torch.ones(1, 1))[1].tolist() == [[6.0, 8.0], [0.0, 0.0]]
    assert cost.in_sizes == []
