"""The quadrotor's gymnasium adapter equals the native environment."""

import gymnasium
import numpy as np
import pytest
import torch

import afm_rl  # noqa: F401  registers the environments
from afm_rl.envs import Circle, CrazyflieTrack

NAME = "afm_rl/CrazyflieTrack-v0"
HOVER = np.array([0.2943, 0, 0, 0], dtype=np.float32)


def test_it_is_the_native_environment():
    changes = {"regime": [{}, {"mass": 0.5}, {"mass": 4 / 3}], "ramp": 1}
    settings = {"sensor_noise": 0.01, "start_noise": 0.1, "duration": 0.5}
    env = gymnasium.make(NAME, reference=Circle(1.0), times=[0.1, 0.3], **changes, **settings)
    native = CrazyflieTrack(Circle(1.0), schedule=[0.1, 0.3], missions=changes, **settings)
    native.set_seed(3, static_seed=True)
    observation, info = env.reset(seed=3)
    data, active = native.reset(), []
    for step in range(10):
        seen = torch.cat([data["observation"], data["reference"][0]])
        np.testing.assert_array_equal(observation, seen.numpy())
        observation, reward, terminated, truncated, info = env.step(HOVER)
        data["action"] = torch.tensor(HOVER)
        after = native.step(data)["next"]
        assert reward == after["reward"].item()
        np.testing.assert_array_equal(info["square_error"], after["square_error"].numpy())
        assert info["time"] == pytest.approx(0.05 * (step + 1))
        active.append(info["regime_active"])
        data = native.step_mdp(data)
    assert active == [False, False] + [True] * 8  # a ramp begins with nothing
    assert (terminated, truncated) == (False, True)
