"""Regimes of the ground robot that remember, flicker, depend on the place, or come slowly."""

import pytest
import torch
from driving import drive
from tensordict import TensorDict

from afm_rl.dynamics import dubins_step
from afm_rl.envs import MissionNoise, UGVTrack
from afm_rl.regimes import ActionGain, Compose, Delay, GainNoise, Patches, Schedule

ALWAYS = {"schedule": Schedule([])}  # the regime holds from the first step


def world():
    gains = ActionGain(["v_gain", "omega_gain"])
    return Compose([Delay(), gains, Patches(), GainNoise()])


def quiet(**settings):
    settings = {"process_noise": 0.0, "start_noise": 0.0, "regime": world(), **settings}
    return UGVTrack(**settings)


ACTIONS = [[0.5, 0.1], [-0.3, 0.2], [1.0, 0.0], [0.2, -0.4]]


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_a_delayed_command_acts_that_many_steps_later(steps):
    env = quiet(**ALWAYS, missions={"regime": {"delay": steps}})
    pose = env.reset()["pose"]
    commands = [[0.0, 0.0]] * steps + ACTIONS
    for result, command in zip(drive(env, env.reset(), ACTIONS), commands, strict=False):
        pose = dubins_step(pose, torch.tensor(command), 0.2)
        torch.testing.assert_close(result["pose"], pose)


def test_the_past_holds_the_clamped_actions_newest_first():
    env = quiet()
    results = drive(env, env.reset(), [[3.0, 0.1], [-0.3, 0.2], [0.5, -9.0]])
    expected = torch.tensor([[0.5, -torch.pi / 2], [-0.3, 0.2], [1.0, 0.1], [0.0, 0.0]])
    torch.testing.assert_close(results[-1]["past"][:4], expected)
    torch.testing.assert_close(results[0]["past"][:2], expected[2:])


def test_the_robot_may_drive_backwards_on_patches():
    env = quiet(**ALWAYS)
    mission = env.mission(regime={"patch_v_gain": -1.0}).expand(2)
    data = env.reset(mission, set_state=False)
    data["pose"] = torch.tensor([[1.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
    (result,) = drive(env, data, [[1.0, 0.0]])
    torch.testing.assert_close(result["pose"][:, 0], torch.tensor([1.2, 2.8]))


def test_a_ramp_is_published_as_it_goes():
    env = quiet(schedule=Schedule([1], by="step"), missions={"regime": {"v_gain": -1.0}, "ramp": 4})
    data = env.reset()
    results = drive(env, data, [[1.0, 0.0]] * 8)
    assert results["since"].tolist() == [0, 2, 2, 2, 2, 2, 2, 2]
    shown = results["regime"][:, 1]
    assert shown.tolist() == pytest.approx([1.0, 1.0, 0.5, 0.0, -0.5, -1.0, -1.0, -1.0])
    assert results["regime_active"].tolist() == [False] * 2 + [True] * 6
    ahead = results["pose"][:, 0].diff()
    torch.testing.assert_close(ahead, 0.2 * shown[:-1], atol=1e-6, rtol=0)


def test_a_mission_may_have_more_changes_of_its_own():
    env = quiet(schedule=Schedule([1], by="step").padded(4))
    gains = [{}, {"v_gain": 2.0}, {"v_gain": 3.0}, {"v_gain": 4.0}]
    missions = [env.mission(regime=gains, at=[0, 1, 2]), env.mission(regime={"v_gain": -1.0})]
    results = drive(env, env.reset(torch.stack(missions), set_state=False), [[0.0, 0.0]] * 4)
    assert results["regime"][..., 1].tolist() == [[2, 1], [3, -1], [4, -1], [4, -1]]


def test_flickering_gains_have_the_spread_that_was_asked_for():
    env = quiet(**ALWAYS, missions={"regime": {"gain_noise": 0.3}})
    data = env.reset(TensorDict(batch_size=[3000]))
    data["pose"][:] = torch.zeros(3)
    (result,) = drive(env, data, [[1.0, 1.0]])
    gains = result["pose"][:, ::2] / 0.2
    torch.testing.assert_close(gains.mean(0), torch.ones(2), atol=0.02, rtol=0)
    torch.testing.assert_close(gains.std(0), torch.full((2,), 0.3), atol=0, rtol=0.05)
    assert abs(float(torch.corrcoef(gains.T)[0, 1])) < 0.06


def test_flickering_gains_shift_no_other_noise():
    settings = {"process_noise": 0.01, "start_noise": 0.02}
    steady = UGVTrack(**settings)
    shaky = quiet(**settings)
    one, other = (drive(env, env.reset(), ACTIONS)["pose"] for env in (steady, shaky))
    assert torch.equal(one, other)


def test_each_kind_of_noise_has_its_stream_and_its_size():
    noise, seeds = MissionNoise(), torch.tensor([3, 3, 4])
    drawn = noise.normal("actuator", seeds)
    assert drawn.shape == (3, 2) and (drawn[0] == drawn[1]).all() and (drawn[0] != drawn[2]).all()
    assert (MissionNoise().normal("process", seeds)[:, :2] != drawn).all()
