"""Environments that map actions to the range of their controls, as hands and kitchens do."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import SyncVectorEnv
from harness import refused
from torchrl.envs import GymWrapper, TransformedEnv

from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper, check_model
from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.transforms import ActionFlowTransform

reacher = pytest.importorskip("gymnasium.envs.mujoco.reacher_v5")
RANGES = np.array([[-0.5, 1.5], [0.0, 1.0]])
MAP = (1.0, 0.5), (0.5, 0.5)  # gains, offsets


class Scaled(reacher.ReacherEnv):
    """A healthy arm: control = middle + half range x action."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.model.actuator_ctrlrange[:] = RANGES
        self.action_space = Box(-1, 1, (2,), np.float32)

    def step(self, action):
        low, high = RANGES.T
        return super().step((low + high) / 2 + action * (high - low) / 2)


@pytest.mark.parametrize("make", [Scaled, lambda: GymWrapper(Scaled())])
def test_the_map_is_named_and_predicts_all_motion(make):
    found = check_model(make(), steps=100)
    assert not found.right and found.share < 0.9
    assert "acts on k u + b of each action u: 1 joint0 + 0.5, 0.5 joint1 + 0.5" in found.cause
    assert found.cause.endswith("the range of the controls (action_map='range')")
    np.testing.assert_allclose(found.action_map, MAP)
    assert found.corrected > 0.999
    for action_map in ("range", found.action_map):
        assert check_model(make(), steps=100, action_map=action_map).right


def test_another_map_is_named_too():
    class Odd(Scaled):
        def step(self, action):
            return reacher.ReacherEnv.step(self, np.array([-0.6, 0.3]) * action + [0.3, 0.5])

    found = check_model(Odd(), steps=100)
    np.testing.assert_allclose(found.action_map, ([-0.6, 0.3], [0.3, 0.5]), atol=0.01)
    assert "range" not in found.cause and found.corrected > 0.99


def steps_of(wrapper):
    wrapper.reset(seed=0)
    for k in range(40):
        plan = (0.3 * np.sin(0.2 * k + np.arange(2))).astype(np.float32)
        plan = plan if isinstance(wrapper, ActionFlowWrapper) else plan[None]
        yield np.abs(wrapper.step(plan)[-1]["afm"]["executed_action"] - plan).max()


@pytest.mark.parametrize("action_map", ["range", MAP])
@pytest.mark.parametrize(
    "shell",
    [
        lambda how: ActionFlowWrapper(Scaled(), action_map=how),
        lambda how: ActionFlowVectorWrapper(SyncVectorEnv([Scaled]), action_map=how),
        lambda how: ActionFlowWrapper(env := Scaled(), MuJoCoDynamics(env, action_map=how)),
    ],
)
def test_with_the_map_nothing_is_corrected(shell, action_map):
    assert max(steps_of(shell(action_map))) < 1e-6


def transformed(model="mujoco", **settings):
    return TransformedEnv(GymWrapper(Scaled()), ActionFlowTransform(model, **settings))


def test_with_the_map_nothing_is_corrected_in_torchrl():
    data = transformed(action_map="range").rollout(20)
    assert not data["next", "afm", "corrected"].any()


@refused(
    (lambda: ActionFlowWrapper(Scaled()).reset(), "action 0 lies between -1 and 1, its control be"),
    (lambda: ActionFlowWrapper(Scaled()).reset(), r"tween -0.5 and 1.5 \(2 of 2.*action_map='ran"),
    (lambda: ActionFlowWrapper(env := Scaled(), MuJoCoDynamics(env)).reset(), "action_map='range'"),
    (lambda: ActionFlowVectorWrapper(SyncVectorEnv([Scaled])).reset(), "action_map='range'"),
    (lambda: transformed().reset(), "action_map='range'"),
    (lambda: ActionFlowWrapper(Scaled(), torch.add, action_map="range"), "the model is given, too"),
    (lambda: transformed(MuJoCoDynamics(Scaled()), action_map="range"), "the model is given, too"),
    (lambda: MuJoCoDynamics(Scaled(), action_map="box"), "expected 'range', or a pair"),
    (lambda: MuJoCoDynamics(Scaled(), action_map=(0.0, 1.0)), "gains not 0"),
    (lambda: MuJoCoDynamics(Scaled(), action_map=([1.0] * 3, 0.0)), "one for each of 2 actions"),
)
def test_what_does_not_fit_is_refused(use):
    use()


def test_ranges_and_home_are_those_of_the_actions():
    model = MuJoCoDynamics(Scaled(), action_map="range")
    assert model.action_low.tolist() == [-1, -1] and model.action_high.tolist() == [1, 1]
    np.testing.assert_allclose(model.home, [-0.5, -1.0])  # the actions of controls 0
    plain, state = MuJoCoDynamics(Scaled()), torch.zeros(8, dtype=torch.float64)
    action = torch.tensor([0.2, -0.4], dtype=torch.float64)
    gain, offset = (torch.tensor(x, dtype=torch.float64) for x in MAP)
    torch.testing.assert_close(model(state, action), plain(state, gain * action + offset))
    torch.testing.assert_close(
        model.jacobian(state, action), plain.jacobian(state, gain * action + offset) * gain
    )
