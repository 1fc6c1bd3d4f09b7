"""Position servos: faults about a pose, many joints, a model that is only nearly exact."""

import math

import gymnasium
import numpy as np
import pytest
import torch

from afm_rl import ActionFlowWrapper
from afm_rl.correction import ActionFlow
from afm_rl.dynamics import KnownDynamics, MuJoCoDynamics
from afm_rl.dynamics.mujoco_model import home_of
from afm_rl.spaces.manifold import Manifold

mujoco = pytest.importorskip("mujoco")
SERVOS = """<mujoco><worldbody><body><joint name="a"/><geom size=".1"/><body><joint name="b"/>
<geom size=".1"/></body></body></worldbody><actuator><position joint="a" kp="20" gear="2"/>
<position joint="b" kp="10"/><motor joint="b"/></actuator><keyframe>
<key name="stand" qpos="0 0"/><key name="home" qpos=".4 -.3"/></keyframe></mujoco>"""


def gait(home, steps, count=8):
    """Return commands ``(T, N, A)`` that move a little about a pose."""
    draws = torch.Generator().manual_seed(0)
    first, size = 6.28 * torch.rand(2, count, len(home), generator=draws)
    time = torch.arange(steps).view(-1, 1, 1)
    waves = (0.4 * time + first).sin() + 0.5 * (0.9 * time + 2 * first).sin()
    return home + 0.06 * (2 + size) * waves + 0.01 * torch.randn(waves.shape, generator=draws)


def miss(drive, flow, plans, effect):
    size = plans.shape[-1]
    model = KnownDynamics(lambda q, u: q + 0.4 * (u - q), Manifold(size), size)
    torch.manual_seed(0)
    start = plans[0]
    _, effects = drive(flow, model, effect, plans, state=start, noise=0.002)
    return (effects - plans).abs().mean((1, 2))


def test_servos_that_are_reversed_about_a_pose_are_found_sooner_with_the_pose(drive):
    home = torch.tensor([0.5, -0.4, 0.3])
    plans = gait(home, 24)

    def effect(sent):
        return sent[-1] if len(sent) < 12 else 2 * home - sent[-1]

    low, high = -torch.ones(3), torch.ones(3)
    flows = ActionFlow(low, high), ActionFlow(low, high, home=home.tolist())
    without, known = (miss(drive, flow, plans, effect) for flow in flows)
    assert known[16:].mean() < 0.5 * without[16:].mean()
    assert known[16:].mean() < 0.25 * known[12]


def test_what_is_said_of_actions_is_in_their_units(line):
    home, scale = torch.tensor([0.5]), 1.5
    flow = ActionFlow(torch.tensor([-1.0]), torch.tensor([1.0]), home=[0.5])
    memory, box = flow.begin(torch.zeros(1)), torch.tensor([[-1.0], [1.0]])
    memory, correction = flow.correct(memory, torch.tensor([0.7]), line(1), box)
    assert correction.executed_action == correction.predicted_effect == 0.7
    assert torch.equal(correction.effect_bounds, box)
    torch.testing.assert_close(correction.noise, torch.tensor([0.05 * scale]))
    mean, std = flow.predict(memory, home, line(1))
    assert (mean - home).abs() < 0.1
    assert 0.0 < std < 0.3


@pytest.mark.parametrize(("pose", "expected"), [(None, [0.8, -0.3, 0.0]), ([0.1, 0.0], None)])
def test_position_servos_are_at_home_in_the_nearest_keyframe(pose, expected):
    model = MuJoCoDynamics(SERVOS)
    home = home_of(model.mjcf, None if pose is None else torch.tensor(pose).numpy())
    assert (home is None) == (expected is None)
    if expected is not None:
        torch.testing.assert_close(home, torch.tensor(expected, dtype=torch.float64))
        assert torch.equal(model.home, home)


@pytest.mark.slow
def test_a_gain_of_twelve_servos_is_found_sooner_than_that_of_one(drive):
    home = torch.zeros(12)
    plans = gait(home, 32)

    def effect(sent):
        return sent[-1] if len(sent) < 12 else 0.5 * sent[-1]

    def after(size):
        errors = [
            miss(drive, ActionFlow(-torch.ones(size), torch.ones(size)), part, effect)
            for part in plans.split(size, -1)
        ]
        return torch.stack(errors).mean(0)[14:].mean()

    assert after(12) < 0.8 * after(1)


@pytest.mark.parametrize("late", [1, 2, 4])
def test_a_delay_of_twelve_servos_is_found_after_four_steps(drive, late):
    home, flow = torch.zeros(12), ActionFlow(-torch.ones(12), torch.ones(12))
    model = KnownDynamics(lambda q, u: q + 0.4 * (u - q), Manifold(12), 12)
    plans, found, observe = gait(home, 20), [], flow.observe

    def observed(memory, state):
        found.append(flow.delay_in(memory))
        return observe(memory, state)

    def effect(sent):
        return sent[-1] if len(sent) < 12 else sent[-1 - late]

    flow.observe = observed
    torch.manual_seed(0)
    drive(flow, model, effect, plans, state=plans[0], noise=0.002)
    found = torch.stack(found)
    assert (found[:12] == 0).all() and (found[15:] == late).all()  # steps 12 to 15 were late


def test_a_healthy_robot_over_an_inexact_model_is_hardly_ever_explained(drive, monkeypatch):
    """The model's noise is a tenth of what it leaves unexplained; two of three rows are usual."""
    model = KnownDynamics(lambda q, u: q + 0.4 * (u - q), Manifold(2), 2, 1e-3)
    plans, steps, explained = gait(torch.zeros(2), 200, count=1), [], set()
    jacobian = KnownDynamics.jacobian

    def counted(*given):
        explained.add(len(steps))
        return jacobian(*given)

    monkeypatch.setattr(KnownDynamics, "jacobian", counted)
    torch.manual_seed(0)
    flow = ActionFlow(-torch.ones(2), torch.ones(2))
    found, _ = drive(flow, model, lambda sent: steps.append(1) or sent[-1], plans, noise=0.01)
    assert len([step for step in explained if step >= 100]) < 45
    torch.testing.assert_close(found[0], plans)


class Servos(gymnasium.Env):
    """Begins in the keyframe that is not called home."""

    action_space = gymnasium.spaces.Box(-2.0, 2.0, (3,))
    observation_space = gymnasium.spaces.Box(-math.inf, math.inf, (4,))
    frame_skip = 1

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(SERVOS.replace('"0 0"', '"0.1 0.2"'))
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        return np.concatenate([self.data.qpos, self.data.qvel]), {}


@pytest.mark.parametrize(("given", "home"), [(None, [0.2, 0.2, 0.0]), ([0.1, 0.1, 0.1],) * 2])
def test_a_wrapper_is_at_home_where_the_first_episode_begins_unless_it_is_told(given, home):
    env = Servos()
    model = "mujoco"
    if given is not None:
        model = MuJoCoDynamics(env)
        model.home = torch.tensor(given)
    wrapper = ActionFlowWrapper(env, model)
    wrapper.reset(seed=0)
    found = wrapper._loop.corrector.home
    torch.testing.assert_close(found, torch.tensor(home).to(found))
