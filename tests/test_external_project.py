"""A cost, a planner, a corrector, a robot and a regime of somebody else's, on the command line."""

from pathlib import Path

import pytest
from harness import agent_trusting
from torch import nn

from afm_rl.correction import Corrector
from afm_rl.errors import ConfigurationError
from afm_rl.missions import run
from afm_rl.missions.factories import as_part

pytestmark = pytest.mark.check
FERRY = Path(__file__).parents[1] / "examples" / "external_project" / "ferry"
REVERSED = ["regimes=[{east_gain: -1, north_gain: -1}]", "robot.schedule.at=[]"]


def agent_of(*overrides):
    return agent_trusting(FERRY, *overrides)


def after(*overrides):
    """Return the reward per step (m) since the change."""
    return run(agent_of("robot=lake", *overrides)).missions["after"].item()


def test_a_robot_brings_its_step_reward_cost_and_regime():
    agent = agent_of("robot=lake", "method=physics")
    names = [
        type(part).__name__
        for part in (agent.planner.env.cost, agent.robot.regime.regimes["current"])
    ]
    assert names == ["Dock", "Current"]
    assert agent.env.base_env.task.name == "drift"
    assert agent.regime_names == ["east = 0.3, north = -0.2"]


def test_a_planner_and_a_corrector_are_chosen_by_name():
    healthy, lost = after("planner=straight"), after("planner=straight", *REVERSED)
    corrected = after("planner=straight", "corrector=reverse", *REVERSED)
    assert healthy > -0.5 and lost < -5 and corrected > healthy - 0.2


@pytest.mark.parametrize("cost", ["dock", "reward"])
def test_corrections_of_ours_follow_plans_for_any_cost(cost):
    agent = agent_of("robot=lake", "method=afm_physics", f"cost={cost}", "budget=4")
    assert len(run(agent).steps) == 4


def test_a_part_of_another_kind_is_refused():
    with pytest.raises(ConfigurationError, match="corrector: its maker: expected a Corrector, got"):
        as_part("corrector", nn.Identity(), Corrector)
