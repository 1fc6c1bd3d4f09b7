"""The world as the planner imagines it."""

import pytest
import torch
from tensordict import TensorDict

from afm_rl.dynamics import Dubins, KnownDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.planning import CEM, ICEM, MPPI, GoalDistance, KnownReward, PlanningEnv
from afm_rl.spaces.manifold import Manifold


def test_a_step_is_a_model_step_and_the_reward_its_negative_cost(world):
    state, goal = torch.randn(4, 6, 3), torch.randn(4, 6, 2)
    td = TensorDict({"observation": state, "goal": goal}, [4, 6])
    td = world.reset(td)
    torch.testing.assert_close(td["observation"], state)
    td["action"] = torch.rand(4, 6, 2)
    after = world.step(td)["next"]
    moved = Dubins()(state, td["action"])
    torch.testing.assert_close(after["observation"], moved)
    torch.testing.assert_close(after["reward"][..., 0], -(moved[..., :2] - goal).norm(dim=-1))
    assert torch.equal(after["goal"], goal) and not after["done"].any()


def test_whole_numbers_bound_real_actions():
    env = PlanningEnv(Dubins(), GoalDistance(), [-1, -2], [1, 2])
    drawn = env.action_spec.rand()
    assert drawn.dtype is torch.float32 and env.action_spec.space.high.tolist() == [1.0, 2.0]


@pytest.mark.parametrize("kind", [MPPI, ICEM, CEM])
@pytest.mark.parametrize(
    ("keys", "cost", "missing"),
    [
        ({"observation_key": ("robot", "pose")}, GoalDistance(), r"\('robot', 'pose'\)"),
        ({}, GoalDistance(in_keys=["gaol"]), "'gaol'"),
    ],
)
def test_an_entry_that_the_environment_lacks_is_named(box, kind, keys, cost, missing):
    planner = kind(PlanningEnv(Dubins(), cost, *box, **keys))
    given = r"the environment gives \['observation', 'goal'\]; name the state"
    words = rf"planner: reads {missing}, but {given}"
    with pytest.raises(ConfigurationError, match=words):
        planner(TensorDict({"observation": torch.zeros(1, 3), "goal": torch.zeros(1, 2)}, [1]))


def single(state, action):
    """A step of one robot: it reads the first dimension, not the last one."""
    return torch.stack([state[0] + action[0], state[1] + action[1]])


def test_functions_that_are_not_batched_are_refused_before_a_plan(box):
    model = KnownDynamics(single, Manifold(2), action_size=2)
    near = KnownReward(lambda state, action, after: -after[0].abs())
    batched = KnownDynamics(lambda state, action: state + action, Manifold(2), action_size=2)
    with pytest.raises(ConfigurationError, match=r"step: returned .*\(4, 1, 2\): a step fu"):
        PlanningEnv(model, GoalDistance(), *box)
    with pytest.raises(ConfigurationError, match=r"cost: returned .* a tensor \(4, 1\), one"):
        PlanningEnv(batched, near, *box)
    with pytest.raises(ConfigurationError, match="dynamics.step: fails .* step function in torch"):
        model(torch.zeros(1, 2), torch.zeros(1, 2))
