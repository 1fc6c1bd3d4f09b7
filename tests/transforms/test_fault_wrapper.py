"""Actuators with faults around environments of gymnasium."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from harness import refused
from puck import Puck, alone

from afm_rl import FaultVectorWrapper, FaultWrapper
from afm_rl.regimes import presets, servo_faults

PLANS = np.random.default_rng(0).uniform(-1, 1, (25, 3, 2))


def reacher():
    return gymnasium.make("Reacher-v5")


def effects(env, commands):
    """Return what reaches an environment in an episode, ``(T, A)``."""
    env.reset(seed=0)
    reached = []
    for command in commands:
        env.step(np.asarray(command))
        reached.append(env.effect.astype(float).round(6).tolist())
    return reached


@pytest.mark.parametrize("count", [1, 2])
def test_every_preset_is_known_by_its_name(count):
    env = FaultWrapper(gymnasium.make("Pendulum-v1") if count == 1 else reacher())
    for name, fault in presets(count).items():
        env.fail(name)
        assert env.faults == [fault]
    assert ("swapped pair" in presets(count)) == (count > 1)


def test_actuators_do_what_is_set():
    swapped = FaultWrapper(reacher(), {"delay": 1, "gain_0": 0.5, "from_0": 1, "from_1": 0})
    found = effects(swapped, [[0.2, 0.8], [0.0, 0.0]])
    np.testing.assert_allclose(found, [[0.0, 0.0], [0.4, 0.2]], rtol=1e-6)
    noisy = np.array(effects(FaultWrapper(reacher(), {"noise": 0.1}), [[0.3, 0.3]] * 200))
    assert noisy.std() == pytest.approx(0.1, rel=0.2) and noisy.mean() == pytest.approx(
        0.3, abs=0.03
    )


def test_each_episode_is_healthy_up_to_the_fault_until_it_fails_at_once():
    env = FaultWrapper(reacher(), "all reversed", at=2)
    for _ in range(2):
        assert effects(env, [[0.5, 0.2]] * 3) == [[0.5, 0.2], [0.5, 0.2], [-0.5, -0.2]]
    env.fail("half")
    assert effects(env, [[0.5, 0.2]]) == [[0.25, 0.1]]
    env.fail("none")
    assert effects(env, [[0.5, 0.2]]) == [[0.5, 0.2]]


def test_servos_have_their_faults_about_their_pose():
    env = FaultWrapper(reacher(), "offset .25 on one", home=[0.5, 0.0])
    assert effects(env, [[0.5, 0.2], [0.9, 0.2]]) == [[0.75, 0.2], [1.0, 0.2]]  # of the space
    assert [*env.presets] == [*servo_faults(2)]
    env.fail({"gain_0": -1.0})
    assert effects(env, [[0.7, 0.2]]) == [[0.3, 0.2]]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_in_a_vector_each_environment_has_actuators_of_its_own(mode):
    faults, ends = [{"gain_0": -1.0}, "late 2", {"rate": 0.2}], (6, 9, 7)
    makers = [lambda end=end: Puck(ends=end) for end in ends]
    envs = FaultVectorWrapper(SyncVectorEnv(makers, autoreset_mode=mode), faults, at=3)
    envs.reset(seed=0)
    reached = []
    for plans in PLANS:
        _, _, ended, _, _ = envs.step(plans)
        reached.append(envs.effect)
        if mode is AutoresetMode.DISABLED and ended.any():
            envs.reset(options={"reset_mask": ended.copy()})
    for row, (make, fault) in enumerate(zip(makers, faults, strict=True)):
        env = FaultWrapper(make(), fault, at=3)
        for step, _ in alone(env, PLANS[:, row], mode):
            np.testing.assert_array_equal(reached[step][row], env.effect)


def test_a_limited_rate_goes_on_from_where_the_actuators_are():
    vector = gymnasium.make_vec("Pendulum-v1", num_envs=3, vectorization_mode="sync")
    envs = FaultVectorWrapper(vector, [{"rate": 0.2}, {"rate": 0.2, "gain_0": -1.0}, "none"], at=1)
    envs.reset(seed=0)
    reached = []
    for command in (2.0, 2.0, -2.0, -2.0):
        envs.step(np.full((3, 1), command, dtype=np.float32))
        reached.append(envs.effect[:, 0].tolist())
    expected = [[2.0, 2.0, 2.0], [2.0, 1.6, 2.0], [1.6, 2.0, -2.0], [1.2, 2.0, -2.0]]
    np.testing.assert_allclose(reached, expected, rtol=1e-6)


@refused(
    (lambda: FaultWrapper(reacher(), "late 99"), "fault='late 99': expected one of none, one rev"),
    (lambda: FaultWrapper(reacher(), {"gain_7": 1.0}), "unknown parameter 'gain_7'"),
    (lambda: FaultWrapper(reacher(), at=-1), "at=-1: expected a whole number of at least 0"),
    (lambda: FaultWrapper(reacher(), ["none"] * 2), "2 faults: expected one, or 1, one of each"),
    (lambda: FaultWrapper(gymnasium.make("CartPole-v1")), r"action_space=Discrete\(2\): expected"),
    (lambda: FaultWrapper(reacher()).step([0.0]), "'action': .* expected real numbers"),
)
def test_what_cannot_be_a_fault_is_refused(make):
    make()
