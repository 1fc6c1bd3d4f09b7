"""Environments of gymnasium are the native ones."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import afm_rl  # noqa: F401  registers the environments
from afm_rl.envs import CrazyflieTrackGym, UGVTrackGym
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import Schedule

NAME = "afm_rl/UGVTrack-v0"


MADE = {
    "a drive": {"id": NAME, "regime": {"v_gain": -1.0}, "schedule": Schedule([0.5])},
    "a drive in pictures": {"id": NAME, "render_mode": "rgb_array"},
    "a flight": {"id": "afm_rl/CrazyflieTrack-v0", "sensor_noise": 0.01},
}


@pytest.mark.filterwarnings("ignore")  # advice on bounds, which positions do not have
@pytest.mark.parametrize("settings", MADE.values(), ids=MADE)
def test_gymnasium_accepts_the_environment(settings):
    env = gymnasium.make(**settings).unwrapped
    check_env(env, skip_render_check=env.render_mode is None)


def test_the_observation_is_pose_and_goal():
    env = gymnasium.make(NAME, start_noise=0.0)
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(observation, [7.2, 5.4, 0.0, 7.2, 5.4], atol=1e-6)
    assert info == {"reached": 0, "progress": 0.0, "regime_active": False}
    assert env.step(np.array([1.0, 0.0]))[-1]["reached"] == 1


@pytest.mark.parametrize("kind", [UGVTrackGym, CrazyflieTrackGym])
def test_impossible_settings_are_named(kind):
    with pytest.raises(ConfigurationError, match="render_mode='human'"):
        kind(render_mode="human")


def test_unseeded_environments_differ():
    assert (UGVTrackGym().reset()[0] != UGVTrackGym().reset()[0]).any()


def test_a_step_before_the_reset_says_so():
    env = UGVTrackGym()
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
