"""The arm in MuJoCo: its geometry, its servos and its task."""

import mujoco
import pytest
import torch

from afm_rl.envs import arm_task
from afm_rl.envs.task.arm import chain, tip_of


@pytest.fixture(scope="module")
def arm():
    return arm_task()


def test_the_tip_is_where_mujoco_says(arm):
    model = arm.world.mjcf
    data, angles = mujoco.MjData(model), torch.linspace(-1, 1, 14).reshape(2, 7).double()
    for row, found in zip(angles, tip_of(angles, *chain(model, "tip")), strict=True):
        data.qpos[:] = row.numpy()
        mujoco.mj_kinematics(model, data)
        torch.testing.assert_close(found, torch.from_numpy(data.site("tip").xpos.copy()))


def test_the_servos_bring_the_joints_to_what_they_are_told(arm):
    state, goal = arm.start(4)
    states = arm.world.rollout(state, goal.expand(1, 40, 7))[0]
    torch.testing.assert_close(states[-1, :7], goal, atol=2e-3, rtol=0.0)
    reward = arm.reward(state, goal, states[-1], goal)
    assert -2e-3 < reward.item() <= 0.0
    assert arm.reward(state, goal, state, goal) < -0.05


def test_goals_can_be_reached_with_62_percent_of_the_commands(arm):
    goals = torch.stack([arm.start(seed)[1] for seed in range(50)])
    assert goals.abs().max() <= 0.62 * arm.high[0]
    assert len(goals.unique(dim=0)) == 50
