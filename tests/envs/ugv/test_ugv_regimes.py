"""Regimes of the ground robot that remember, flicker, depend on the place, or come slowly."""

import numpy as np
import pytest
import torch
from harness import refused
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from afm_rl.dynamics import dubins_step
from afm_rl.envs import MissionNoise, UGVTrack, UGVTrackGym
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain, Compose, Delay, GainNoise, Patches, Schedule

ALWAYS = {"schedule": Schedule([])}  # the regime holds from the first step


def world():
    gains = ActionGain(["v_gain", "omega_gain"])
    families = {"delay": Delay(), "gain": gains, "patches": Patches(), "noise": GainNoise()}
    return Compose(families)


def quiet(**settings):
    settings = {"process_noise": 0.0, "start_noise": 0.0, "regime": world(), **settings}
    return UGVTrack(**settings)


def drive(env, data, actions):
    """Take one action after another in all missions; return what each step led to."""
    record = []
    for action in actions:
        data["action"] = torch.as_tensor(action, dtype=env.dtype).expand(*data.batch_size, 2)
        record.append(env.step(data)["next"].clone())
        data = env.step_mdp(data)
    return record


def steer(data):
    """Drive towards the goal."""
    away = data["goal"] - data["pose"][:2]
    turn = torch.atan2(away[1], away[0]) - data["pose"][2]
    return torch.stack([turn.cos(), turn.sin()]).numpy()


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_specs_hold(batch, dtype):
    env = quiet(batch_size=batch, max_steps=3, dtype=dtype, missions={"ramp": 2})
    check_env_specs(env, break_when_any_done="both")
    data = env.rollout(2)
    assert {data[key].dtype for key in ("pose", "goal", "regime", "past")} == {dtype}
    assert data["next", "reward"].dtype is dtype and data["past"].shape == (*batch, 2, 25, 2)
    assert "past" not in UGVTrack(batch_size=batch).reset()


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
    assert [result["since"].item() for result in results] == [0, 2, 2, 2, 2, 2, 2, 2]
    shown = [float(result["regime"][1]) for result in results]
    assert shown == pytest.approx([1.0, 1.0, 0.5, 0.0, -0.5, -1.0, -1.0, -1.0])
    assert [bool(result["regime_active"]) for result in results] == [False] * 2 + [True] * 6
    ahead = [
        after["pose"][0] - before["pose"][0]
        for before, after in zip(results, results[1:], strict=False)
    ]
    torch.testing.assert_close(
        torch.stack(ahead), 0.2 * torch.tensor(shown[:-1]), atol=1e-6, rtol=0
    )


def test_a_mission_may_have_more_changes_of_its_own():
    env = quiet(schedule=Schedule([1], by="step").padded(4))
    gains = [{}, {"v_gain": 2.0}, {"v_gain": 3.0}, {"v_gain": 4.0}]
    missions = [env.mission(regime=gains, at=[0, 1, 2]), env.mission(regime={"v_gain": -1.0})]
    results = drive(env, env.reset(torch.stack(missions), set_state=False), [[0.0, 0.0]] * 4)
    shown = [result["regime"][:, 1].tolist() for result in results]
    assert shown == [[2, 1], [3, -1], [4, -1], [4, -1]]


def test_a_state_is_set_with_its_history():
    env = quiet(**ALWAYS, missions={"regime": {"delay": 1, "v_gain": 0.5}, "ramp": 3})
    data = drive(env, env.reset(), ACTIONS)[-1]
    again = env.reset(data.select(*env.state_spec.keys()), set_state=True)
    assert (again["past"] == data["past"]).all() and again["since"] == data["since"]
    fresh = env.reset(data.select("pose", "mission"), set_state=True)
    assert (fresh["past"] == 0).all() and (fresh["pose"] == data["pose"]).all()


def test_a_partial_reset_forgets_the_past_of_its_missions_only():
    env = quiet(batch_size=(2,))
    data = env.step_mdp(env.step(env.reset().set("action", torch.ones(2, 2))))
    held = data["past"].clone()
    data["_reset"] = torch.tensor([[True], [False]])
    again = env.reset(data, set_state=False)
    assert (again["past"][0] == 0).all() and (again["past"][1] == held[1]).all()


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
    record = [drive(env, env.reset(), ACTIONS) for env in (steady, shaky)]
    assert all((a["pose"] == b["pose"]).all() for a, b in zip(*record, strict=True))


def test_a_row_is_the_same_alone_as_in_a_batch_and_after_a_stop():
    regimes = [{"delay": 1, "gain_noise": 0.4}, {"patch_v_gain": -1.0}, {"gain_noise": 0.2}]
    env = quiet(**ALWAYS, process_noise=0.01)
    missions = torch.stack([env.mission(seed=k, regime=r) for k, r in enumerate(regimes)])
    together = drive(env, env.reset(missions, set_state=False), ACTIONS)
    for row in range(3):
        env.set_seed(0)
        alone = drive(env, env.reset(missions[row], set_state=False), ACTIONS)
        assert all((a[row] == b).all() for a, b in zip(together, alone, strict=True))
    env.set_seed(0)
    half = drive(env, env.reset(missions, set_state=False), ACTIONS[:2])[-1]
    streams, data = env.state_dict(), half.select(*env.observation_spec.keys())
    for stay in (torch.arange(3), torch.tensor([2, 0])):  # as they were, and when one has left
        other = quiet(**ALWAYS, process_noise=0.01)
        other.load_state_dict(streams)
        rest = drive(other, data[stay], ACTIONS[2:])
        assert all((a[stay] == b).all() for a, b in zip(together[2:], rest, strict=True))


def test_each_kind_of_noise_has_its_stream_and_its_size():
    noise, seeds = MissionNoise(), torch.tensor([3, 3, 4])
    drawn = noise.normal("actuator", seeds)
    assert drawn.shape == (3, 2) and (drawn[0] == drawn[1]).all() and (drawn[0] != drawn[2]).all()
    assert (MissionNoise().normal("process", seeds)[:, :2] != drawn).all()


def test_gym_and_native_agree():
    phases = [{}, {"v_gain": 0.5}, {"delay": 1}, {"gain_noise": 0.3}]
    settings = {"regime": phases, "schedule": [0.0, 0.06, 0.15], "ramp": 2}
    native = UGVTrack(regime=world(), schedule=Schedule([]).padded(4), seed=7)
    mission = native.mission(seed=7, regime=phases, at=[0.0, 0.06, 0.15], ramp=2)
    data = native.reset(mission, set_state=False)
    single = UGVTrackGym(track="ethz_2", family=world(), **settings)
    seen = single.reset(seed=7)[0]
    for _ in range(25):
        action = steer(data)
        data = native.step_mdp(native.step(data.set("action", torch.as_tensor(action))))
        seen = single.step(action)[0]
        np.testing.assert_array_equal(seen[:3], data["pose"].numpy())
    assert data["regime"].tolist() != list(native.regime.identity)


@pytest.mark.parametrize("ramp", [-1, 0.5, True])
def test_impossible_ramps_are_refused(ramp):
    for make in (lambda: UGVTrackGym(ramp=ramp), lambda: UGVTrack().mission(ramp=ramp)):
        with pytest.raises(ConfigurationError, match=f"missions: ramp={ramp}"):
            make()


@refused(
    ({"at": [0.1, 0.2, 0.3], "regime": [{}] * 4}, r"at=.*at most 2 breakpoints; .*padded"),
    ({"at": 0.5}, "missions: at=0.5: expected a list"),
    ({"at": [0.5], "regime": [{}] * 3}, "one for each of 2 phases"),
)
def test_impossible_breakpoints_are_refused(arguments):
    UGVTrack().mission(**arguments)
