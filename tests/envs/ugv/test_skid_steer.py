"""The ground robot in MuJoCo: how it drives, and what can happen to it."""

import pytest
import torch
from driving import drive

from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.envs import UGVTrack, WheelPhysics, skid_steer
from afm_rl.regimes import ActionGain, Compose


@pytest.fixture(scope="module")
def robot():
    return skid_steer()


def driven(robot, v, omega, steps=10, **physics):
    """Return the mean speed along the heading, and the mean turn rate, once under way."""
    robot.set_physics(WheelPhysics().encode(physics))
    plan = torch.tensor([[v, omega]], dtype=torch.float64).expand(1, steps, 2)
    states = robot.rollout(torch.zeros(20, dtype=torch.float64), plan)[0]
    half = states[steps // 2 :]
    speed = half[:, 10] * half[:, 2].cos() + half[:, 11] * half[:, 2].sin()
    return speed.mean().item(), half[:, 12].mean().item()


def test_it_drives_and_turns_nearly_as_it_is_told(robot):
    assert driven(robot, 1.0, 0.0) == pytest.approx((1.0, 0.0), abs=0.05)
    speed, rate = driven(robot, 0.5, 0.8)
    assert speed == pytest.approx(0.5, abs=0.05)
    assert rate == pytest.approx(0.8, abs=0.2)


def test_a_wheel_that_runs_backwards_pulls_to_its_side_and_brakes(robot):
    speed, rate = driven(robot, 1.0, 0.0, wheel_rear_left=-1.0)
    assert 0.5 < speed < 0.9
    assert rate > 0.4
    assert driven(robot, 1.0, 0.0, wheel_rear_right=-1.0)[1] < -0.4


def test_on_ice_it_needs_longer_until_it_is_under_way(robot):
    dry, ice = (driven(robot, 1.0, 0.0, steps=2, friction=share)[0] for share in (1.0, 0.1))
    assert ice < 0.6 * dry


def test_a_load_off_the_centre_and_a_flat_tyre_change_the_body(robot):
    row = WheelPhysics().encode(
        {"payload": 1.0, "payload_x": -0.1, "payload_y": 0.1, "tyre_rear_left": 0.75}
    )
    (body,) = robot.step.models(row[None].double().numpy())
    assert body.body_mass.sum() == pytest.approx(2 * robot.mjcf.body_mass.sum())
    # The load, 17 kg, is in a body that weighs 15 kg without it.
    moved = body.body("base").ipos - robot.mjcf.body("base").ipos
    assert moved == pytest.approx([-0.1 * 17 / 32, 0.1 * 17 / 32, 0.0], abs=1e-6)
    assert body.geom("rear_left").size[0] == pytest.approx(0.75 * 0.098, abs=1e-6)
    assert body.geom("rear_right").size[0] == pytest.approx(0.098)


def test_nominal_physics_are_the_model_itself(robot):
    robot.set_physics(torch.tensor(WheelPhysics.identity).expand(3, -1))
    assert torch.equal(robot.physics_now, robot.nominal.expand(3, -1))
    assert robot.step.models(torch.tensor([WheelPhysics.identity]).numpy()) == [robot.mjcf]


def test_actions_are_mixed_into_controls(robot):
    wheels = MuJoCoDynamics(robot.mjcf, 20)
    state, action = torch.zeros(20).double(), torch.tensor([0.5, 0.3]).double()
    robot.set_physics(None)
    torch.testing.assert_close(robot(state, action), wheels(state, robot.gain @ action))
    assert robot.jacobian(state, action).shape == (20, 2)
    assert robot.linearise(state, action)[2].shape == (20, 2)


def test_missions_have_physics_of_their_own_and_show_as_much_as_is_observed():
    family = Compose({"gain": ActionGain(["v_gain", "omega_gain"]), "physics": WheelPhysics()})
    env = UGVTrack(
        ["ethz_2"], family, world=skid_steer(), observed=3, process_noise=0.0, start_noise=0.0
    )
    kinds = [{}, {"v_gain": -1.0}, {"friction": 0.1}, {"v_gain": -1.0, "friction": 0.1}]

    def run(kinds):
        missions = [env.mission(0, 1, [regime], at=[]) for regime in kinds]
        data = env.reset(torch.stack(missions), set_state=False)
        start = data["pose"]
        data = drive(env, data, [[1.0, 0.0]] * 4)[-1]
        assert data["observation"].shape == (len(kinds), 3)
        world = env.simulation.world
        assert torch.equal(world.physics_now, world.nominal)  # nothing stays in the environment
        return (data["pose"] - start)[:, 0]

    together = run(kinds)
    assert together[0] > 0.5 and together[1] == pytest.approx(-together[0].item(), abs=0.05)
    assert together[2] < 0.8 * together[0]
    torch.testing.assert_close(torch.cat([run([kind]) for kind in kinds]), together)
