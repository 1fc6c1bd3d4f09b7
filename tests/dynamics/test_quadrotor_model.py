"""The quadrotor's equations against closed forms, and its derivatives."""

import numpy as np
import pytest
import roma
import torch
from harness import flights, level, refused

from afm_rl.dynamics import DynamicsModel, Quadrotor
from afm_rl.dynamics import quadrotor as equations
from afm_rl.dynamics.quadrotor import quadrotor_path, quadrotor_rate, quadrotor_step
from afm_rl.spaces.airframe import QuadrotorBody, mix, unmix, within_motors

BODY = QuadrotorBody()
INERTIA = torch.tensor(BODY.inertia, dtype=torch.float64)


def test_the_body_is_the_published_one():
    assert BODY.max_force == pytest.approx(0.14375)
    assert BODY.max_thrust == pytest.approx(0.575)
    assert BODY.hover_thrust == pytest.approx(0.2943)
    low, high = BODY.bounds
    assert low == (0.0, *(-x for x in high[1:]))
    assert high == pytest.approx((0.575, 6.6125e-3, 6.6125e-3, 9.75e-4))


@refused(
    ({"mass": 0.0}, r"body.mass=0.0: expected a finite number in \(0, inf\]"),
    ({"arm": float("nan")}, "body.arm=nan"),
    ({"gravity": -9.81}, r"body.gravity=-9.81: expected a finite number in \[0, inf\]"),
    ({"inertia": 1e-5}, "body.inertia=1e-05: expected three moments"),
    ({"inertia": (1e-5, 1e-5)}, "expected three moments"),
    ({"inertia": (1e-5, 1e-5, 0.0)}, "body.inertia=0.0"),
)
def test_impossible_bodies_are_refused(settings):
    QuadrotorBody(**settings)


def test_the_mixer_is_the_published_one():
    arm, drag = BODY.arm, BODY.k_d / BODY.k_t
    columns = mix(torch.eye(4, dtype=torch.float64), BODY).T
    expected = [[1, 1, 1, 1], [0, arm, 0, -arm], [-arm, 0, arm, 0], [drag, -drag, drag, -drag]]
    torch.testing.assert_close(columns, torch.tensor(expected, dtype=torch.float64))
    forces = torch.rand(5, 2, 4, dtype=torch.float64)
    torch.testing.assert_close(unmix(mix(forces, BODY), BODY), forces)


def test_motors_saturate_one_by_one():
    forces = torch.tensor([0.2, 0.05, -0.01, 0.1], dtype=torch.float64)
    given = unmix(within_motors(mix(forces, BODY), BODY), BODY)
    torch.testing.assert_close(given, forces.clamp(0.0, BODY.max_force), rtol=1e-12, atol=1e-15)


def test_actions_within_the_means_of_the_motors_are_kept_to_the_bit():
    forces = 0.01 + 0.12 * torch.rand(1000, 4)
    action = mix(forces, BODY)
    assert (within_motors(action, BODY) == action).all()


def test_the_rate_is_that_of_a_rigid_body():
    state, action = flights(50)
    found = quadrotor_rate(state, action, BODY)
    turn, spin = state[:, 6:10], state[:, 10:]
    push = roma.unitquat_to_rotmat(turn)[..., 2] * action[:, :1] / BODY.mass
    push[:, 2] -= BODY.gravity
    torch.testing.assert_close(found[:, :3], state[:, 3:6])
    torch.testing.assert_close(found[:, 3:6], push)
    # in the body frame the quaternion changes by half the rate
    flow = torch.func.jvp(lambda q: roma.quat_action(q, spin), (turn,), (found[:, 6:10],))[1]
    torch.testing.assert_close(flow, torch.zeros_like(flow), rtol=0, atol=1e-12)
    lever = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).expand_as(spin)
    flow = torch.func.jvp(lambda q: roma.quat_action(q, lever), (turn,), (found[:, 6:10],))[1]
    torch.testing.assert_close(flow, roma.quat_action(turn, torch.linalg.cross(spin, lever)))
    turning = INERTIA * found[:, 10:] + torch.linalg.cross(spin, INERTIA * spin)
    torch.testing.assert_close(turning, action[:, 1:], rtol=1e-12, atol=1e-18)


def test_angular_momentum_and_energy_are_conserved_without_moments():
    body = QuadrotorBody(inertia=(1e-5, 2e-5, 3.5e-5))
    inertia = torch.tensor(body.inertia, dtype=torch.float64)
    state = level(dtype=torch.float64)
    state[10:] = torch.tensor([3.0, 0.1, -2.0])
    path = quadrotor_path(state, torch.zeros(4), 2.0, 1000, body)
    spin = path[:, 10:]
    momentum = roma.quat_action(path[:, 6:10], inertia * spin)
    torch.testing.assert_close(momentum, momentum[:1].expand_as(momentum), rtol=1e-8, atol=1e-14)
    energy = (inertia * spin.square()).sum(-1)
    torch.testing.assert_close(energy, energy[:1].expand_as(energy), rtol=1e-8, atol=0)
    assert (spin[-1] - spin[0]).norm() > 1.0  # it tumbled


def test_the_error_falls_with_the_fourth_power_of_the_step():
    state, action = flights(20)
    exact = quadrotor_step(state, action, 0.4, 800, BODY)
    errors = [
        (quadrotor_step(state, action, 0.4, steps, BODY) - exact).norm().item()
        for steps in (8, 16, 32)
    ]
    for coarse, fine in zip(errors, errors[1:], strict=False):
        assert 13 < coarse / fine < 19


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (25,), (2, 3)])
def test_a_flight_is_the_same_to_the_bit_in_any_batch(batch, dtype):
    state, action = (x.to(dtype) for x in flights(400))
    whole = quadrotor_path(state, action, 0.05, 25, BODY)
    count = torch.Size(batch).numel()
    part = quadrotor_path(
        state[:count].reshape(*batch, 13), action[:count].reshape(*batch, 4), 0.05, 25, BODY
    )
    assert part.dtype is dtype
    assert (part.reshape(25, count, 13) == whole[:, :count]).all()


def test_the_jacobian_at_rest_is_finite():
    found = Quadrotor().jacobian(level(dtype=torch.float64), torch.zeros(4, dtype=torch.float64))
    assert found.shape == (12, 4) and found.isfinite().all()


@pytest.mark.parametrize("first", ["inference", "forward", "vmap"])
def test_constants_serve_training_wherever_they_were_made(first):
    equations._tables.cache_clear()
    state, action = flights(2)
    if first == "inference":
        with torch.inference_mode():
            Quadrotor().linearise(state.clone(), action.clone())
    elif first == "forward":
        DynamicsModel.linearise(Quadrotor(), state, action)
    else:
        torch.func.vmap(torch.func.jacrev(Quadrotor()))(state, action)
    action.requires_grad_()
    Quadrotor()(state, action).sum().backward()
    by_action = Quadrotor().linearise(state, action.detach())[2]
    torch.testing.assert_close(action.grad, by_action.sum(-2))


def test_agrees_with_rotorpy():
    """The same rigid body, integrated by another library: equal to 1e-9 after 50 ms."""
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
    arm, (x, y, z) = BODY.arm, BODY.inertia
    places = [[arm, 0, 0], [0, arm, 0], [-arm, 0, 0], [0, -arm, 0]]
    parameters = {
        **{"mass": BODY.mass, "Ixx": x, "Iyy": y, "Izz": z, "Ixy": 0.0, "Ixz": 0.0, "Iyz": 0.0},
        **{"num_rotors": 4, "rotor_directions": np.array([1, -1, 1, -1]), "tau_m": 0.1},
        "rotor_pos": {f"r{i}": np.array(place) for i, place in enumerate(places)},
        **{"rotor_speed_min": 0, "rotor_speed_max": BODY.rotor_speed},
        **{"k_eta": BODY.k_t, "k_m": BODY.k_d},
    }
    exact = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    other = multirotor.Multirotor(parameters, aero=False, integrator_kwargs=exact)
    states, actions = flights(10)
    actions = within_motors(actions, BODY)
    speeds = (unmix(actions, BODY).clamp(min=0) / BODY.k_t).sqrt().numpy()
    ours = quadrotor_step(states, actions, 0.05, 100, BODY)
    for state, speed, expected in zip(states.numpy(), speeds, ours, strict=True):
        before = {"x": state[:3], "v": state[3:6], "q": state[6:10], "w": state[10:]}
        before |= {"wind": np.zeros(3), "rotor_speeds": speed}
        after = other.step(before, {"cmd_motor_speeds": speed}, 0.05)
        found = np.concatenate([after[key] for key in "xvqw"])
        np.testing.assert_allclose(expected.numpy(), found, rtol=0, atol=1e-9)
