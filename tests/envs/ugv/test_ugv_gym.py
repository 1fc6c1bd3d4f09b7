"""The gymnasium adapters."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from torchrl.envs import GymWrapper
from torchrl.envs.utils import check_env_specs

import afm_rl  # noqa: F401  registers the environments
from afm_rl.envs import CrazyflieTrackGym, UGVTrackGym, UGVTrackVectorEnv
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import Schedule

NAME = "afm_rl/UGVTrack-v0"


def make_vec(**settings):
    return gymnasium.make_vec(
        NAME, vectorization_mode="vector_entry_point", **{"num_envs": 4, **settings}
    )


def ready(env, steps_taken):
    """Reset, and give each mission a number of steps it has already taken."""
    env.reset(seed=0)
    env._data["step"] = torch.tensor(steps_taken)
    return env


@pytest.mark.parametrize("mode", [None, "rgb_array"])
def test_gymnasium_accepts_the_environment(mode):
    env = gymnasium.make(NAME, track="ethz_1", regime={"v_gain": -1.0}, render_mode=mode)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice on bounds, which positions do not have
        check_env(env.unwrapped, skip_render_check=mode is None)


def test_the_observation_is_pose_and_goal():
    env = gymnasium.make(NAME, start_noise=0.0)
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(observation, [7.2, 5.4, 0.0, 7.2, 5.4], atol=1e-6)
    assert info == {"reached": 0, "progress": 0.0, "regime_active": False}
    observation, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0]))
    np.testing.assert_allclose(observation[:3], [7.4, 5.4, 0.0], atol=1e-3)
    assert reward == pytest.approx(0.8, abs=1e-3)
    assert (terminated, truncated, info["reached"]) == (False, False, 1)


def test_regimes_can_be_written_in_two_ways():
    by_name = UGVTrackGym(regime={"v_gain": -2.0})
    by_phase = UGVTrackGym(regime=[{}, {"v_gain": -2.0}, {}], schedule=(0.15, 0.80))
    rows = [env.native.reset()["mission", "parameters"] for env in (by_name, by_phase)]
    assert rows[0].tolist() == [[1, 1], [-2, 1], [1, 1]]
    assert (rows[0] == rows[1]).all()
    both = UGVTrackGym(regime={"v_gain": -2.0, "omega_gain": 0.5}, schedule=Schedule([0.5]))
    assert both.native.reset()["mission", "parameters"].tolist() == [[1, 1], [-2, 0.5]]


@pytest.mark.parametrize("kind", [UGVTrackGym, UGVTrackVectorEnv, CrazyflieTrackGym])
def test_impossible_settings_are_named(kind):
    with pytest.raises(ConfigurationError, match="render_mode='human'"):
        kind(render_mode="human")


def test_the_time_limit_is_gymnasiums():
    env = gymnasium.make(NAME, max_episode_steps=2)
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, dtype=np.float32))[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]


def test_seeds_decide():
    env = UGVTrackGym()
    first, again = env.reset(seed=3)[0], env.reset(seed=3)[0]
    following = env.reset()[0]
    assert (first == again).all()
    assert (first != following).any()
    assert (UGVTrackGym().reset()[0] != UGVTrackGym().reset()[0]).any()  # unseeded


def test_a_batch_is_what_its_missions_are_alone():
    batch = make_vec(regime={"v_gain": 2.0}, num_envs=3)
    alone = gymnasium.make_vec(NAME, num_envs=3, vectorization_mode="sync", regime={"v_gain": 2.0})
    seen, other = batch.reset(seed=5)[0], alone.reset(seed=5)[0]
    assert (seen == other).all()
    rng = np.random.default_rng(0)
    for _ in range(30):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        result, expected = batch.step(actions), alone.step(actions)
        assert (result[0] == expected[0]).all()
        np.testing.assert_allclose(result[1], expected[1])


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_torchrl_wraps_the_batch_over_resets(mode):
    env = make_vec(autoreset_mode=mode, max_episode_steps=6)
    assert env.metadata["autoreset_mode"] is mode
    wrapped = GymWrapper(env)
    check_env_specs(wrapped)
    data = wrapped.rollout(20, break_when_any_done=False)
    done = data["next", "done"][..., 0]
    assert done[0].nonzero().flatten().tolist() == [5, 11, 17]
    last, first = data["next", "observation"][:, :-1], data["observation"][:, 1:]
    assert (last == first)[~done[:, :-1]].all()
    assert (last != first)[done[:, :-1]].any(-1).all()
    assert (first[done[:, :-1]][:, :2] - data["observation"][0, 0, 3:]).norm(dim=-1).max() < 0.2


def test_one_mission_ends_and_is_reset_in_the_same_step():
    env = ready(make_vec(num_envs=3, max_episode_steps=5), [0, 4, 0])
    observation, _, terminated, truncated, info = env.step(np.ones((3, 2), dtype=np.float32))
    assert truncated.tolist() == [False, True, False]
    assert not terminated.any()
    assert info["_final_obs"].tolist() == [False, True, False]
    assert info["final_obs"][0] is None
    assert info["final_obs"][1][0] > observation[1, 0] + 0.1  # it had moved
    assert info["final_info"]["reached"][1] == 1
    assert info["final_info"]["_reached"].tolist() == [False, True, False]
    assert info["reached"].tolist() == [1, 0, 1]


def test_without_autoreset_a_mask_resets():
    env = ready(UGVTrackVectorEnv(3, AutoresetMode.DISABLED, max_episode_steps=5), [0, 4, 0])
    moved, _, _, truncated, info = env.step(np.ones((3, 2), dtype=np.float32))
    assert truncated.tolist() == [False, True, False]
    assert "final_obs" not in info
    observation, info = env.reset(options={"reset_mask": truncated})
    assert info["reached"].tolist() == [1, 0, 1]
    assert (observation[[0, 2]] == moved[[0, 2]]).all()
    with pytest.raises(ConfigurationError, match="reset_mask"):
        env.reset(options={"reset_mask": np.ones(2, dtype=bool)})


def test_next_step_autoreset_is_refused():
    with pytest.raises(ConfigurationError, match="autoreset_mode"):
        UGVTrackVectorEnv(2, AutoresetMode.NEXT_STEP)


@pytest.mark.parametrize("env", [UGVTrackGym(), UGVTrackVectorEnv(2)])
def test_a_step_before_the_reset_says_so(env):
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(env.action_space.sample())


def test_pictures_show_the_trail():
    env = UGVTrackGym(render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(10):
        env.step(np.array([1.0, 0.0]))
    after = env.render()
    assert before.shape == after.shape == (*before.shape[:2], 3)
    assert (before != after).any()
    batch = make_vec(num_envs=2, render_mode="rgb_array")
    batch.reset(seed=0)
    assert [frame.shape for frame in batch.render()] == [before.shape] * 2
