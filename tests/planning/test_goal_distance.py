"""Distance to the goal as a cost."""

import torch

from afm_rl.planning import GoalDistance


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
