"""Missions in other people's tasks, from settings to tables."""

import math

import pytest
import torch
from hydra import compose, initialize_config_module

from afm_rl.errors import ConfigurationError
from afm_rl.missions import build, run
from afm_rl.missions.return_score import _measured

FLIP = "regimes=[{gain_0: -1}]"
SMALL = ["planner.population=16", "planner.elites=4", "planner.horizon=8"]
PENDULUM = ["robot=gymnasium", "robot.id=Pendulum-v1"]


def agent_of(*overrides):
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        return build(compose("config", list(overrides)), ["tests"])


def row_of(*overrides):
    return run(agent_of(*overrides)).missions.iloc[0]


def test_a_reversal_is_undone_in_a_task_of_dm_control():
    pytest.importorskip("dm_control")
    reacher = ["robot=dm_control", "robot.domain=reacher", "robot.task=easy", "robot.steps=60"]
    flipped = ["regimes=[{gain_0: -1, gain_1: -1}]", "robot.schedule.at=[]", "seeds=[1]"]
    planner = ["planner.population=24", "planner.elites=6"]
    found = {
        method: row_of(*reacher, *flipped, *planner, f"method={method}")
        for method in ("physics", "afm_physics", "oracle")
    }
    assert found["physics"]["after"] < 0.1
    assert found["afm_physics"]["after"] >= 0.9
    assert found["oracle"]["after"] >= 0.9
    assert math.isnan(found["oracle"]["before"])


def test_rewards_before_and_after_a_change():
    rewards = torch.tensor([1.0] * 100 + [0.0] * 30 + [1.0] * 70)
    assert _measured(rewards, 100) == [1.0, 0.0, 1.0, 28.0]
    assert _measured(rewards, 0)[1:3] == [1.0, pytest.approx(0.7)]
    assert math.isnan(_measured(0.0 * rewards + torch.arange(200) // -100, 100)[3])
    assert _measured(-rewards, 100)[3] == 0.0


def test_the_change_comes_when_the_schedule_says(tmp_path):
    small = [*PENDULUM, *SMALL, "robot.steps=30", FLIP, "method=physics"]
    for more, at in ((["robot.schedule.at=[0.5]"], 15), (["robot.schedule.at=[]"], 0)):
        agent = agent_of(*small, *more)
        results = run(agent)
        active = results.steps["regime_active"].tolist()
        assert active.index(1) == at
        assert agent.base_env.simulation.changes_at(agent.missions["mission"]).item() == at


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["robot=gymnasium", "robot.id=Nothing-v0"], "robot.id='Nothing-v0': .*doesn't exist"),
        (["robot=gymnasium", "robot.id=Swimmer-v5"], "robot.id=Swimmer-v5: its reward is not"),
        (["robot=dm_control", "robot.domain=nothing"], "robot.domain=nothing robot.task=hard: "),
        (["robot=dm_control", "robot.task=nothing"], "robot.domain=reacher robot.task=nothing: "),
        (["robot=mujoco"], "robot.xml: expected a setting"),
        (["robot=mujoco", "robot.xml=no.xml", "robot.reward=tests.x"], "robot.reward='tests.x': "),
        ([*PENDULUM, "robot.reward=os.getcwd"], "robot.reward='os.getcwd': only parts of afm_rl"),
        ([*PENDULUM, "tracks=ethz_2"], "tracks=.*: expected all, or Pendulum-v1"),
        ([*PENDULUM, "cost=goal_position"], "cost: reads 2 numbers from 'goal'"),
        (["cost=reward"], "cost=reward: robot=ugv has no reward"),
    ],
)
def test_mistakes_are_said_in_one_line(overrides, message):
    with pytest.raises(ConfigurationError, match=message) as error:
        agent_of(*overrides, "method=physics")
    assert "\n" not in str(error.value)
