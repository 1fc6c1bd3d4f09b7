"""A model is compared with an environment."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import NormalizeObservation
from puck import Puck, push
from torchrl.envs import GymEnv

from afm_rl import check_model
from afm_rl.dynamics import Dubins
from afm_rl.envs import UGVTrack


def test_an_environment_of_gymnasium():
    assert check_model(Puck(ends=7), push, seed=3).right
    found = check_model(Puck(ends=7, gain=-1.0), push, lambda seen: -seen[:2] - seen[2:], steps=80)
    assert found.steps == 80 and found.factor == pytest.approx([-1.0])
    assert found.cause == "acts on -1 times the action (a sign)"
    nested = check_model(Puck(nested=True), push, state=lambda env, seen: seen["puck"])
    assert nested.right and nested.names[0] == "state[0]"


def test_normalised_observations():
    env = NormalizeObservation(Puck(ends=50))
    found = check_model(env, push)
    assert "(normalised observations, units)" in found.cause and found.corrected > 0.99
    assert found.factor == pytest.approx(np.sqrt(env.obs_rms.var + env.epsilon), rel=0.05)
    assert env.update_running_mean


@pytest.mark.parametrize("make", [gymnasium.make, GymEnv])
@pytest.mark.parametrize(("skip", "cause"), [(None, ""), (1, "makes 2 steps of the model in one")])
def test_a_simulator(skip, cause, make, tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    from afm_rl.dynamics import MuJoCoDynamics

    monkeypatch.chdir(tmp_path)  # where MuJoCo would say that a simulation explodes
    env = make("InvertedPendulum-v5")
    inner = getattr(env, "_env", env)
    found = check_model(env, "mujoco" if skip is None else MuJoCoDynamics(inner, skip))
    assert found.right is (not cause) and found.cause.startswith(cause)
    assert found.names == ("q_slider", "q_hinge", "v_slider", "v_hinge")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("batch", [(), (3,)])
def test_an_environment_of_torchrl(batch):
    env = UGVTrack(batch_size=batch)
    assert check_model(env, Dubins(), steps=60).right
    found = check_model(env, lambda s, a: Dubins()(s, a * torch.tensor([1.0, -1.0])), steps=60)
    assert found.cause == "acts on -1 times action[1] (signs, gains or units)"
