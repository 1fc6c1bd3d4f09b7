"""The check distinguishes wrong from correct models, and names the mistake."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from harness import refused
from scipy.spatial.transform import Rotation

from afm_rl.diagnosis.model_check import check_transitions
from afm_rl.dynamics import KnownDynamics, MuJoCoDynamics
from afm_rl.spaces.manifold import Manifold

DEGREE = math.pi / 180


def upright(state, torque, dt=0.05, gravity=10.0, angle=1.0):
    """A pendulum that stands on its head: angle (rad), speed (rad/s); torque (N m)."""
    speed = state[..., 1:] + dt * (1.5 * gravity * (angle * state[..., :1]).sin() + 3 * torque)
    return torch.cat([state[..., :1] + dt * speed, speed], -1)


def law(state, rng):
    """Keep it upright."""
    return np.clip(-12 * state[:1] - 3 * state[1:], -2, 2)


def shaken(state, rng):
    """Keep it upright, and let its torque show."""
    return np.clip(law(state, rng) + 0.4 * rng.standard_normal(1), -2, 2)


def random(state, rng):
    return rng.uniform(-2, 2, 1)


def drive(policy=random, noise=0.0, late=0, rows=300, robot=upright):
    """Return states, actions and next states of a healthy robot."""
    rng, sent = np.random.default_rng(0), [np.zeros(1)] * late
    state = torch.tensor([0.3, 0.0]).double()
    seen, told = state.numpy(), []
    for _ in range(rows):
        sent.append(policy(seen, rng))
        state = robot(state, torch.from_numpy(sent[-1 - late]))
        after = state.numpy() + noise * rng.standard_normal(2)
        told.append((seen, sent[-1], after))
        seen = after
    return [np.stack(column) for column in zip(*told, strict=True)]


def check(model, rows, manifold=None, names=("angle", "speed")):
    size = rows[0].shape[1], rows[1].shape[1]
    known = KnownDynamics(model, manifold or Manifold(size[0]), size[1])
    return check_transitions(known, *rows, names)


WRONG = {
    "sign": (lambda s, a: upright(s, -a), "acts on -1 times the action (a sign)", -1),
    "degrees": (lambda s, a: upright(s, DEGREE * a), "57.3 times the action (degrees for", 57.3),
    "hundredth": (lambda s, a: upright(s, 0.01 * a), "acts on 100 times the action", 100),
    "half": (lambda s, a: upright(s, 0.5 * a), "acts on 2 times the action (a gain or", 2),
    "dt / 10": (lambda s, a: upright(s, a, dt=0.005), r"dt", 10),
    "dt / 2": (lambda s, a: upright(s, a, dt=0.025), r"dt", 2),
    "dt * 2": (lambda s, a: upright(s, a, dt=0.1), r"dt", 0.5),
    "angle": (partial(upright, angle=DEGREE), "has angle in radians, not in degrees", 57.3),
    "gravity": (lambda s, a: upright(s, a, gravity=-10.0), "gravity", None),
}


@pytest.mark.parametrize("policy", [random, law, shaken])
@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_named(wrong, policy):
    model, cause, factor = WRONG[wrong]
    found = check(model, drive(policy))
    assert not found.right and found.share < 0.95
    assert cause in found.cause and found.corrected > max(0.55, found.share)
    if factor is not None:
        assert found.factor[0] == pytest.approx(factor, rel=0.25)
    assert found.cause in str(found) and f"{100 * found.corrected:.0f} %" in str(found)


@pytest.mark.parametrize(
    ("policy", "noise", "right"),
    [(random, 0.0, True), (law, 0.0, True), (random, 0.02, True), (law, 0.02, False)],
)
def test_a_right_model_is_not_accused(policy, noise, right):
    """Noise that hides the motion leaves open whether it is right."""
    found = check(upright, drive(policy, noise))
    assert found.right is right and not found.cause
    assert ("it is right" in str(found) or "model is right" in str(found)) is right
    if not noise:
        assert found.predicted == pytest.approx((1.0, 1.0), abs=1e-4)


def finer(state, torque):
    """Two steps of half the length."""
    return upright(upright(state, torque, dt=0.025), torque, dt=0.025)


def walled(state, torque):
    """A wall that it falls against."""
    after = upright(state, torque)
    return torch.where(after[..., :1] > 0.2, torch.tensor([0.2, 0.0]).double(), after)


@pytest.mark.parametrize(("robot", "right"), [(finer, True), (walled, False)])
def test_what_is_no_usual_mistake_is_none(robot, right):
    found = check(upright, drive(robot=robot))
    assert found.right is right and not found.cause


@pytest.mark.parametrize("policy", [random, shaken])
@pytest.mark.parametrize("wrong", ["sign", "degrees", "dt / 2"])
def test_noise_does_not_hide_what_is_wrong(wrong, policy):
    model, cause, _ = WRONG[wrong]
    found = check(model, drive(policy, noise=0.01))
    assert cause.split(" times")[-1].split(" (")[0] in found.cause and not found.right


def puck(state, action):
    """Two places and speeds."""
    speed = state[..., 2:] + 0.1 * action
    return torch.cat([state[..., :2] + 0.1 * speed, speed], -1)


def cart(count=2):
    """Return steps of a cart on a plane under random forces."""
    rng, state, rows = np.random.default_rng(0), np.zeros(2 * count), []
    for _ in range(300):
        action = rng.uniform(-1, 1, count)
        after = puck(torch.from_numpy(state), torch.from_numpy(action)).numpy()
        rows.append((state, action, after))
        state = 0.95 * after if abs(after).max() > 1 else after
    return [np.stack(column) for column in zip(*rows, strict=True)]


def scaled(rows, scale, offset):
    return [(rows[0] - offset) / scale, rows[1], (rows[2] - offset) / scale]


def turning(state, action):
    return state + action


def wrapped():
    """Return an angle that a sensor wraps at pi."""
    rng = np.random.default_rng(0)
    state, action = rng.uniform(-3, 3, (300, 1)), rng.uniform(0, 0.5, (300, 1))
    return state, action, (state + action + np.pi) % (2 * np.pi) - np.pi


def within_a_step(late):
    """A robot whose actions begin to act within a step."""
    last = [torch.zeros(1).double()]

    def robot(state, action):
        state = upright(state, last[0], dt=0.05 * late)
        last[0] = action
        return upright(state, action, dt=0.05 * (1 - late))

    return robot


def held(count):
    """A robot that takes the first of so many actions for all of them."""
    taken = []

    def robot(state, action):
        taken.append(taken[-1] if len(taken) % count else action)
        return upright(state, taken[-1])

    return robot


def episodes(count):
    """Return the steps of two episodes; the first ends before the next action is taken."""
    both = (drive(policy, rows=301, robot=held(count)) for policy in (random, shaken))
    return [np.concatenate(rows) for rows in zip(*both, strict=True)]


def mirrored(*axes):
    """Return the cart's steps, read by sensors of which some have another sign."""
    return scaled(cart(), np.where(np.isin(range(4), axes), -1, 1), 0.0)


LINEAR = [0.05, 0.1], [0.01, -0.02]
ONE_WRONG = torch.tensor([1.0, -2.0])
NAMES = {upright: ("angle", "speed"), puck: ("x", "y", "vx", "vy"), turning: ("angle",)}


@pytest.mark.parametrize(
    ("model", "rows", "cause"),
    [
        (upright, lambda: drive(late=1), "acts 1 step late"),
        (upright, lambda: drive(law, late=3), "acts 3 steps late"),
        (upright, lambda: episodes(2), "each action for 2 steps (a loop at another rate)"),
        (upright, lambda: drive(shaken, robot=held(3)), "holds each action for 3 steps (a loop"),
        (puck, lambda: [x[1:] if k != 1 else x[:-1] for k, x in enumerate(cart())], "next row"),
        (puck, lambda: mirrored(0), "has x mirrored (the sign of an axis)"),
        (puck, lambda: mirrored(0, 3), "has x, vy mirrored (the sign of an axis)"),
        (puck, lambda: mirrored(1, 2), "has y, vx mirrored (the sign of an axis)"),
        (upright, lambda: scaled(drive(), DEGREE, 0.0), "has angle, speed in degrees"),
        (upright, lambda: scaled(drive(law), [0.045, 0.08], [0.01, -0.02]), "normalised"),
        (upright, lambda: scaled(drive(shaken), *LINEAR), "0.05 angle +0.01, 0.1 speed -0.02"),
        (lambda s, a: puck(s, a * ONE_WRONG), cart, "acts on -0.5 times action[1] ("),
        (turning, wrapped, "turns through pi in angle (Manifold(1, angles=[0]))"),
    ],
)
def test_other_mistakes(model, rows, cause):
    found = check(model, rows(), names=NAMES.get(model, ()))
    assert cause in found.cause and found.corrected > 0.99


@pytest.mark.parametrize(("late", "policy"), [(0.3, random), (0.5, shaken)])
def test_a_fraction_of_a_step_late(late, policy):
    found = check(upright, drive(policy, robot=within_a_step(late)))
    assert found.factor == pytest.approx([late], abs=0.05) and found.corrected > 0.85
    assert "steps late, or interpolates between commands" in found.cause


ARM = """<mujoco><compiler angle="radian"/><option timestep=".002"/><default><joint axis="0 1 0"
damping="2" armature=".05" range="-2.8 2.8"/><position ctrlrange="-2 2"/></default>
<worldbody><body><joint name="a"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
<body pos=".3 0 0"><joint name="b"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/></body>
</body></worldbody><actuator><position joint="a" kp="60"/><position joint="b" kp="40"/></actuator>
</mujoco>"""
SATELLITE = """<mujoco><option timestep=".002" gravity="0 0 0"/><default><motor
ctrlrange="-.02 .02"/></default><worldbody><body><freejoint/><geom type="box" size=".1 .12 .05"
mass="1"/><site name="s"/></body></worldbody><actuator><motor site="s" gear="0 0 0 1 0 0"/><motor
site="s" gear="0 0 0 0 1 0"/><motor site="s" gear="0 0 0 0 0 1"/></actuator></mujoco>"""
NOW = (1.0,) * 10  # share of the new command in each step of the simulation


def simulate(mjcf, commands=NOW, read=lambda state: state):
    """Return states as they are read, actions and next states of a MuJoCo robot."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(mjcf)
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(0), []
    if model.nq == 7:
        data.qpos[3:] = rng.standard_normal(4) / 2
        data.qvel[:] = rng.uniform(-1, 1, 6)
        mujoco.mj_forward(model, data)
        data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
    last, now = np.zeros(model.nu), read(np.r_[data.qpos, data.qvel])
    for _ in range(150):
        action = rng.uniform(*model.actuator_ctrlrange.T)
        for share in commands:
            data.ctrl[:] = last + share * (action - last)
            mujoco.mj_step(model, data)
        before, now, last = now, read(np.r_[data.qpos, data.qvel]), action
        rows.append((before, action, now))
    return [np.stack(column) for column in zip(*rows, strict=True)]


def turned(part, back):
    """Reads three numbers of a state in the other frame: the world's, or back in the body's."""

    def read(state):
        rotation = Rotation.from_quat(np.roll(state[3:7], -1))
        state[part] = (rotation.inv() if back else rotation).apply(state[part])
        return state

    return read


@pytest.mark.parametrize(
    ("mjcf", "told", "cause"),
    [
        (ARM, {}, ""),
        (ARM, {"commands": (0.0,) * 5 + NOW[:5]}, "acts 0.5 steps late"),
        (ARM, {"commands": (0.0,) * 3 + NOW[:7]}, "acts 0.3 steps late"),
        (ARM, {"commands": np.arange(1, 11) / 10}, "interpolates between commands over a step"),
        (ARM, {"commands": NOW[:5]}, "makes 5 of the 10 steps of the simulation"),
        (SATELLITE, {}, ""),
        (SATELLITE, {"read": lambda s: s[[0, 1, 2, 4, 5, 6, 3, *range(7, 13)]]}, "x, y, z, w"),
        (SATELLITE, {"read": turned(slice(10, 13), False)}, "rates of turning in the world's"),
        (SATELLITE, {"read": turned(slice(7, 10), True)}, "velocity in the body's frame"),
    ],
)
def test_a_simulator(mjcf, told, cause):
    found = check_transitions(MuJoCoDynamics(mjcf, frame_skip=10), *simulate(mjcf, **told))
    assert cause in found.cause and found.right is (not cause)
    assert (found.corrected if cause else found.share) > 0.99


def test_an_mjcf_whose_ranges_are_in_degrees():
    model = MuJoCoDynamics(ARM.replace(' angle="radian"', ""), frame_skip=10)
    found = check_transitions(model, *simulate(ARM))
    assert 'an MJCF without angle="radian"' in found.cause and found.corrected > 0.99


def test_a_manifold_that_turns_is_right():
    assert check(turning, wrapped(), Manifold(1, angles=[0]), ("angle",)).right


def test_a_model_that_predicts_no_numbers_predicts_nothing():
    found = check(lambda s, a: s * torch.nan, drive())
    assert found.share == 0.0 and not found.right and not found.cause


def test_rows_that_are_no_numbers_do_not_count():
    rows = drive()
    rows[2][7] = np.nan
    assert check(upright, rows).steps == 299


@refused(
    (lambda s, a, n: (s[:9], a[:9], n[:9]), "expected 20 rows or more, of"),
    (lambda s, a, n: (s, a[:, [0, 0]], n[:, :1]), r"next states \[\(300, 2\), \(300, 2\), "),
    (lambda s, a, n: (s, a, s), "the robot does not move in 300 steps"),
)
def test_what_shows_nothing_is_refused(change):
    check_transitions(KnownDynamics(lambda s, a: s, Manifold(2), 1), *change(*drive()))
