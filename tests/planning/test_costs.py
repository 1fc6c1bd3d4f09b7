"""What planners minimise."""

import math

import pytest
import torch
from tensordict import TensorDict

from afm_rl.dynamics import KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.planning import MPPI, GoalDistance, KnownReward, PlanningEnv, TrackingCost
from afm_rl.spaces.manifold import Manifold


def cost_of(cost, state, goal):
    state = torch.as_tensor(state)
    return cost(torch.zeros_like(state), torch.zeros(2), state, torch.as_tensor(goal))


def test_a_coordinate_without_a_goal_is_driven_to_zero():
    pose = GoalDistance([0, 1, 2])
    assert float(cost_of(pose, [0.0, 0.0, -2.0], [2.0, 1.0])) == 3.0


def test_weights_scale_coordinates():
    cost = GoalDistance([2, 1], weights=[2.0, 0.0])
    assert float(cost_of(cost, [0.0, 9.0, 0.0], [1.5, -4.0])) == 3.0


def test_states_and_goals_broadcast():
    states, goals = torch.randn(4, 7, 3), torch.randn(4, 1, 2)
    result = cost_of(GoalDistance(), states, goals)
    torch.testing.assert_close(result, (states[..., :2] - goals).norm(dim=-1))


def test_it_may_depend_on_the_task():
    def near(state, action, after, goal):
        return -(after - goal).norm(dim=-1)

    cost = KnownReward(near, in_keys=[["task", "goal"]], in_sizes=[1])
    assert cost.in_keys == [("task", "goal")]
    push = KnownDynamics(lambda s, a: s + a, Manifold(1), action_size=1)
    planner = MPPI(PlanningEnv(push, cost, [-1.0], [1.0]), horizon=1, candidates=500)
    td = TensorDict({"observation": torch.zeros(2, 1)}, [2])
    td["task", "goal"] = torch.tensor([[0.5], [-0.25]])
    td["mppi", "mean"] = torch.zeros(2, 1, 1)
    torch.testing.assert_close(planner(td)["action"], td["task", "goal"], rtol=0, atol=0.02)


def test_a_reward_with_an_argument_missing_or_too_many_is_named():
    for reward, keys in ((lambda s: s, []), (lambda s, a: s, []), (lambda s, a, n: s, ["goal"])):
        with pytest.raises(ConfigurationError, match="cost.reward.*a function of [34] arg"):
            KnownReward(reward, keys, [1] * len(keys))


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


def test_sizes_that_do_not_fit_are_told(cost):
    with pytest.raises(ConfigurationError, match="3 state coordinates and 2 .* are 4 and 2"):
        cost.quadratic(torch.zeros(3, 4), torch.zeros(2, 2), torch.zeros(1, 2))


def test_without_a_reference_all_coordinates_have_targets_of_their_own():
    cost = TrackingCost([1.0, 2.0], [0.0], coordinates=[], rest=[0.0, 1.0], in_keys=[])
    state = torch.tensor([[3.0, 3.0], [0.0, 1.0]])
    assert cost(state, torch.ones(2, 1), state).tolist() == [17.0, 0.0]
    assert cost.quadratic(state, torch.ones(1, 1))[1].tolist() == [[6.0, 8.0], [0.0, 0.0]]
    assert cost.in_sizes == []
