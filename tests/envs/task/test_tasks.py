"""Other people's tasks: their worlds and rewards are those of the packages they come from."""

import math

import numpy as np
import pytest
import torch

from afm_rl.envs import TaskEnv, dm_control_task, gymnasium_task, mujoco_task
from afm_rl.errors import ConfigurationError, NonFiniteError

mujoco = pytest.importorskip("mujoco")
gymnasium = pytest.importorskip("gymnasium")
STEPS = 40


def drive(task, seed, actions):
    """Return states and rewards of an episode."""
    env = TaskEnv(task, missions={"seed": seed}, dtype=torch.float64)
    td, states, rewards = env.reset(), [], []
    for action in actions:
        states.append(td["observation"])
        td["action"] = action
        td = env.step(td)["next"]
        rewards.append(td["reward"].item())
        if td["done"].any():
            break
    return torch.stack(states), torch.tensor(rewards).double()


@pytest.fixture
def actions():
    def make(size, reach=1.0):
        generator = torch.Generator().manual_seed(0)
        drawn = 2 * torch.rand(STEPS, size, generator=generator, dtype=torch.float64) - 1
        return reach * drawn

    return make


@pytest.mark.parametrize(
    ("name", "reach"),
    [
        ("Pendulum-v1", 2.0),
        ("InvertedPendulum-v5", 3.0),
        ("Reacher-v5", 1.0),
        ("HalfCheetah-v5", 1.0),
    ],
)
def test_gymnasium(name, reach, actions):
    task, env = gymnasium_task(name), gymnasium.make(name)
    plan = actions(len(task.low), reach)
    env.reset(seed=7)
    expected = []
    for action in plan:
        _, reward, ended, _, _ = env.step(action.numpy())
        expected.append(reward)
        if ended:
            break
    _, rewards = drive(task, 7, plan)
    assert len(rewards) == len(expected)
    torch.testing.assert_close(rewards, torch.tensor(expected).double(), rtol=1e-3, atol=1e-3)
    assert task.dt == pytest.approx(getattr(env.unwrapped, "dt", 0.05))


@pytest.mark.parametrize(
    ("domain", "name"),
    [
        ("cartpole", "balance"),
        ("cartpole", "swingup"),
        ("reacher", "easy"),
        ("reacher", "hard"),
        ("ball_in_cup", "catch"),
        ("cheetah", "run"),
    ],
)
def test_dm_control(domain, name, actions):
    suite = pytest.importorskip("dm_control.suite")
    task = dm_control_task(domain, name)
    env = suite.load(domain, name, task_kwargs={"random": np.random.RandomState(7)})
    env.reset()
    plan = actions(len(task.low))
    states, rewards = drive(task, 7, plan)
    for action, state, reward in zip(plan, states, rewards, strict=True):
        found = np.concatenate([env.physics.data.qpos, env.physics.data.qvel])
        np.testing.assert_allclose(state, found, rtol=0, atol=1e-2)
        assert env.step(action.numpy()).reward == pytest.approx(reward.item(), abs=2e-3)
    if domain == "reacher":  # random actions touch hardly anything
        goal = task.start(7)[1]
        env.physics.data.qpos = [0.3, -0.5]
        mujoco.mj_forward(env.physics.model.ptr, env.physics.data.ptr)
        gap = env.physics.finger_to_target_dist()
        after = torch.tensor([0.3, -0.5, 0.0, 0.0]).double()
        plain = task.planned(after, torch.zeros(2), after, goal)
        assert -plain.item() == pytest.approx(gap, abs=1e-6)


def test_episodes_begin_by_seed_and_begin_elsewhere_after_a_reset():
    env = TaskEnv(gymnasium_task("Pendulum-v1"), max_steps=3, batch_size=[2])
    data = env.rollout(6, break_when_any_done=False)["observation"][:, ::3]
    again = env.rollout(6, break_when_any_done=False)["observation"][:, ::3]
    assert torch.equal(data[:, 0], again[:, 0])
    assert len(data.reshape(-1, 2).unique(dim=0)) == 4


CART = """<mujoco><compiler settotalmass="2"/><worldbody><body><joint name="x" type="slide"
axis="1 0 0"/><geom size=".1"/></body></worldbody><actuator><motor joint="x" ctrlrange="-1 1"/>
</actuator></mujoco>"""


def test_rewards_that_are_no_numbers_are_refused():
    """A return of 0 would be the best of all where rewards are negative."""
    with pytest.raises(ConfigurationError, match=r"robot.reward: is nan in the first state, \["):
        mujoco_task(CART, lambda state, action, after: math.nan * after[..., 0])
    task = mujoco_task(CART, lambda state, action, after: (after[..., 0] + 0.01).sqrt())
    with pytest.raises(NonFiniteError, match="mjcf: the reward is nan in the state"):
        drive(task, 0, -torch.ones(200, 1))


def test_deprecations_in_others_files_alone_are_not_repeated():
    said, before = [], mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        gymnasium_task("HalfCheetah-v5")
        assert said == []
        with pytest.warns(UserWarning, match="settotalmass"):  # a user's file
            mujoco_task(CART, lambda state, action, after: -after[..., 0].abs())
        assert said == []
    finally:
        mujoco.set_mju_user_warning(before)
