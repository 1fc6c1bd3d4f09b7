"""Rewards of other people's tasks as costs."""

import pytest
import torch
from tensordict import TensorDict

from afm_rl.dynamics import KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.planning import MPPI, KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold


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
