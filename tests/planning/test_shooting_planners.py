"""TorchRL's planners under this library's names."""

import pytest
import torch
from tensordict import TensorDict

from afm_rl.dynamics import Dubins
from afm_rl.planning import CEM, GoalDistance, PlanningEnv, TorchRLMPPI

PLANNERS = [CEM, TorchRLMPPI]


@pytest.fixture
def world(box):
    return PlanningEnv(Dubins(), GoalDistance(), *box)


@pytest.mark.parametrize("kind", PLANNERS)
@pytest.mark.parametrize("batch", [(), (3,)])
def test_actions_are_in_the_box(world, kind, batch):
    td = TensorDict({"observation": torch.randn(*batch, 3), "goal": torch.ones(*batch, 2)}, batch)
    td["of no concern"] = torch.zeros(*batch, 1)
    out = kind(world, horizon=3, population=20, iterations=2, elites=5)(td)
    assert out["action"].shape == (*batch, 2)
    assert all(world.action_spec.is_in(action) for action in out["action"].reshape(-1, 2))


@pytest.mark.parametrize("kind", PLANNERS)
def test_they_drive_towards_the_goal(world, kind):
    planner = kind(world, horizon=4, population=60, iterations=3, elites=8)
    goal = torch.tensor([2.0, 1.0])
    td = TensorDict({"observation": torch.zeros(3), "goal": goal}, [])
    for _ in range(20):
        td["observation"] = Dubins()(td["observation"], planner(td)["action"])
    assert float((td["observation"][:2] - goal).norm()) < 0.6
