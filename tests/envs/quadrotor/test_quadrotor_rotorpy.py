"""The quadrotor in RotorPy: its motors, what changes about it, and missions with it."""

import copy

import numpy as np
import pytest
import torch
from driving import drive
from tensordict import TensorDict

from afm_rl.envs import Hover, RotorPyTrack, rotorpy_crazyflie
from afm_rl.envs.quadrotor import rotorpy as quadrotor_rotorpy
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import Schedule
from afm_rl.spaces.airframe import QuadrotorBody, mix, unmix, within_motors

pytest.importorskip("rotorpy")
pytest.importorskip("roma")
pytest.importorskip("torchdiffeq")

STILL = Schedule([], by="step")
TICKS, SUBSTEPS = 4, 5
ASKED = [0.32, 4e-5, -3e-5, 2e-5]


def fly(env, values=(), actions=ASKED, ticks=TICKS):
    """Return the last tick of flights under regimes."""
    missions = torch.stack([env.mission(regime=dict(one)) for one in values or ({},)])
    return drive(env, env.reset(missions, set_state=False), [actions] * ticks)[-1]


def peer(params, wind=(0.0, 0.0, 0.0)):
    """Fly RotorPy's vehicle of one, which is another program than its batch of vehicles."""
    from rotorpy.vehicles.multirotor import Multirotor

    vehicle = Multirotor(params, control_abstraction="cmd_motor_speeds")
    body = rotorpy_crazyflie()
    speed = np.sqrt(body.hover_thrust / (4 * body.k_t))
    state = {
        **{"x": np.zeros(3), "v": np.zeros(3), "q": np.array([0.0, 0.0, 0.0, 1.0])},
        **{"w": np.zeros(3), "wind": np.array(wind), "rotor_speeds": np.full(4, speed)},
    }
    asked = within_motors(torch.tensor(ASKED, dtype=torch.float64), body)
    control = {"cmd_motor_speeds": (unmix(asked, body) / body.k_t).sqrt().numpy()}
    for _ in range(TICKS * SUBSTEPS):
        state = vehicle.step(state, control, 0.05 / SUBSTEPS)
    return np.concatenate([state[name] for name in ("x", "v", "q", "w", "rotor_speeds")])


def changed(**params):
    from rotorpy.vehicles.crazyflie_params import quad_params

    return {**copy.deepcopy(quad_params), **params}


def moved(share, x, y):
    """Return RotorPy's parameters with a load, about the new centre of mass."""
    params = changed()
    centre = share / (1 + share) * np.array([x, y, 0.0])
    params["mass"] *= 1 + share
    params["rotor_pos"] = {name: at - centre for name, at in params["rotor_pos"].items()}
    return params


def test_a_flight_is_rotorpys():
    cases = [
        ({}, peer(changed())),
        ({"mass": 0.5}, peer(changed(mass=0.015))),
        ({"inertia": 2.0}, peer(changed(Ixx=2.86e-5, Iyy=2.86e-5, Izz=5.78e-5))),
        ({"wind_x": 5.0, "wind_z": -1.0}, peer(changed(), wind=(5.0, 0.0, -1.0))),
        (
            {"payload": 0.5, "payload_x": 2e-3, "payload_y": -1e-3},
            peer(moved(0.5, 2e-3, -1e-3)),
        ),
    ]
    env = RotorPyTrack(Hover(), dtype=torch.float64, schedule=STILL, substeps=SUBSTEPS)
    last = fly(env, [values for values, _ in cases])
    found = torch.cat([last["pose"], last["rotors"]], -1)
    expected = torch.tensor(np.stack([state for _, state in cases]))
    # RotorPy computes the batch in single precision, and adapts its steps for one vehicle.
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=2e-4)


def test_a_weak_motor_pushes_and_turns_less():
    """Rolling, pitching and climbing of a motor at half its thrust, from the airframe alone."""
    env = RotorPyTrack(Hover(), schedule=STILL, substeps=SUBSTEPS)
    body = rotorpy_crazyflie()
    hover = [body.hover_thrust, 0.0, 0.0, 0.0]
    state = fly(env, [{"motor_2": 0.98}], hover, ticks=1)["pose"][0]
    lost = torch.tensor([0.0, 0.02, 0.0, 0.0]) * body.hover_thrust / 4
    thrust, *moments = (-mix(lost, body)).tolist()
    assert state[5].item() == pytest.approx(0.05 * thrust / body.mass, rel=0.02)
    for rate, moment, inertia in zip(state[10:].tolist(), moments, body.inertia, strict=True):
        assert rate == pytest.approx(0.05 * moment / inertia, rel=0.05)


def test_what_acts_on_the_action_comes_before_the_motors():
    env = RotorPyTrack(Hover(), schedule=STILL, substeps=SUBSTEPS)
    half = fly(env, [{"thrust_gain": 0.5}], [0.4, 0.0, 0.0, 0.0])
    asked = fly(env, [{}], [0.2, 0.0, 0.0, 0.0])
    torch.testing.assert_close(half["pose"], asked["pose"])


def test_the_wrench_is_what_lagging_motors_gave():
    env = RotorPyTrack(Hover(), schedule=STILL, substeps=10)
    body = rotorpy_crazyflie()
    asked = [1.2 * body.hover_thrust, 0.0, 0.0, 0.0]
    first, last = (fly(env, [{}], asked, ticks)["wrench"][0] for ticks in (1, 20))
    gone = (first[0].item() - body.hover_thrust) / (0.2 * body.hover_thrust)
    lag = 0.072 / 0.05  # of the mean over a tick, in a linear motor
    assert gone == pytest.approx(1 - lag * (1 - np.exp(-1 / lag)), abs=0.03)
    torch.testing.assert_close(last, torch.tensor(asked), rtol=1e-4, atol=1e-8)
    # Of a weak motor, too: it is what a healthy one would have given.
    weak = fly(env, [{"motor_1": 0.98}], asked, 1)["wrench"][0]
    torch.testing.assert_close(weak, first)


def test_a_lost_flight_stays():
    env = RotorPyTrack(Hover(), schedule=STILL, substeps=1, limit=1e-3)
    lost = fly(env, [{}], ticks=3)
    again = env.step(lost.set("action", torch.tensor([[0.5, 0.0, 0.0, 0.0]])))["next"]
    assert lost["lost"].all()
    for name in ("pose", "rotors", "wrench"):
        torch.testing.assert_close(again[name], lost[name])


def test_the_model_is_of_the_same_body():
    body = rotorpy_crazyflie()
    assert body.max_thrust == pytest.approx(0.575)
    assert body.bounds[1][1:] == pytest.approx([2**0.5 * 0.043 * 0.14375] * 2 + [9.75e-3])


@pytest.mark.parametrize("motors", [None, (0, 90, 180), (0, 90, 180, "back"), (0, 90, 180, 1e999)])
def test_motors_need_directions(motors):
    with pytest.raises(ConfigurationError, match=r"body\.motors"):
        QuadrotorBody(motors=motors)


def test_it_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(quadrotor_rotorpy, "quad_params", None)
    with pytest.raises(ConfigurationError, match=r"install afm-rl\[rotorpy\]"):
        RotorPyTrack()


def test_a_mission_starts_from_any_state():
    env = RotorPyTrack(Hover(), schedule=STILL, substeps=1)
    level = torch.zeros(2, 13).index_fill(1, torch.tensor(9), 1.0)
    data = env.reset(TensorDict({"pose": level}, [2]), set_state=True)
    torch.testing.assert_close(data["rotors"], torch.full((2, 4), 1788.55), rtol=1e-4, atol=0.0)
