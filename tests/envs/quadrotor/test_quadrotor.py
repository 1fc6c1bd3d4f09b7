"""The quadrotor environment: plant, phases, errors, ends and resets."""

import pytest
import torch
from driving import act, drive
from harness import refused
from tensordict import TensorDict

from afm_rl.dynamics import Quadrotor
from afm_rl.dynamics.quadrotor import quadrotor_path
from afm_rl.envs import Circle, CrazyflieTrack, Hover, Reference
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import ActionGain, MassFactor, Schedule
from afm_rl.spaces.airframe import QuadrotorBody, within_motors

BODY = QuadrotorBody()
HOVER = (BODY.hover_thrust, 0.0, 0.0, 0.0)


def test_a_step_is_the_rigid_body_under_what_the_motors_give():
    env = CrazyflieTrack(dtype=torch.float64)
    action = torch.tensor([0.5, 5e-3, -4e-3, 1e-4], dtype=torch.float64)  # beyond the motors
    given = within_motors(action, BODY)
    assert (given != action).any()
    after = act(env, env.reset(), action)
    expected = Quadrotor(substeps=25)(env.reset()["pose"], given)
    torch.testing.assert_close(after["pose"], expected, rtol=1e-12, atol=1e-12)
    assert (after["observation"] == after["pose"]).all()


@pytest.mark.parametrize(
    ("settings", "speed"),
    [
        ({}, 0.8),
        ({"preview": False}, 0.0),
        ({"preview": False, "start": "moving"}, 0.8),
        ({"start": "rest"}, 0.0),
    ],
)
def test_flights_start_on_the_reference_as_the_protocol_has_it(settings, speed):
    pose = CrazyflieTrack(**settings).reset()["pose"]
    assert pose.tolist() == pytest.approx([2, 0, 0, 0, speed, 0, 0, 0, 0, 1, 0, 0, 0])


def test_the_reference_is_previewed_or_held():
    circle = Circle(1.0, 0.7)
    for preview in (True, False):
        env = CrazyflieTrack(circle, preview=preview, start="moving", horizon=4)
        seen = drive(env, env.reset(), [HOVER] * 3)["reference"][-1]
        ticks = torch.arange(3, 8) if preview else torch.full((5,), 3)
        torch.testing.assert_close(seen, circle.at(ticks * 0.05 + 0.002))  # the metric's


def test_the_trace_is_the_flight_between_two_ticks():
    env = CrazyflieTrack(dtype=torch.float64, trace=True, substeps=5)
    data = env.reset(TensorDict(batch_size=[2]))
    assert (data["trace"] == data["observation"].unsqueeze(-2)).all()
    action = torch.tensor([0.4, 1e-5, 0.0, 0.0], dtype=torch.float64)
    first = act(env, data, action)
    expected = quadrotor_path(data["pose"], action.expand(2, 4), 0.05, 5, BODY).movedim(0, -2)
    torch.testing.assert_close(first["trace"][:, 1:], expected, rtol=1e-12, atol=1e-12)
    second = act(env, env.step_mdp(data), action)
    for trace, before, after in ((first, data, first), (second, first, second)):
        assert (trace["trace"][:, 0] == before["observation"]).all()
        assert (trace["trace"][:, -1] == after["observation"]).all()
    assert "trace" not in CrazyflieTrack().reset()


def test_sensors_see_the_trace():
    env = CrazyflieTrack(Hover(), sensor_noise=[0.1, 0.2, 0.3, 0.4], trace=True, substeps=3)
    data = env.reset(TensorDict(batch_size=[3000]))
    after = act(env, data, HOVER)
    assert (after["trace"][:, 0] == data["observation"]).all()
    assert (after["trace"][:, -1] == after["observation"]).all()
    for each in (data, after):
        assert (each["pose"] == each["pose"][0]).all()  # which is not noisy
        length = each["observation"][:, 6:10].norm(dim=-1)
        torch.testing.assert_close(length, torch.ones(3000))
    assert (data["observation"] != after["observation"]).any()
    seen, pose = after["trace"], data["pose"].unsqueeze(-2)  # it hovers
    spread = Quadrotor().manifold.difference(seen, pose.expand_as(seen)).std(0)
    expected = torch.tensor([0.1, 0.2, 0.3, 0.4]).repeat_interleave(3).expand(4, 12)
    torch.testing.assert_close(spread, expected, rtol=0.1, atol=0)
    quiet = CrazyflieTrack(Hover(), sensor_noise=[0.1, 0.2, 0.3, 0.4], substeps=3)
    same = act(quiet, quiet.reset(TensorDict(batch_size=[3000])), HOVER)
    assert (same["observation"] == after["observation"]).all()  # whether there is a trace or not


def test_the_error_is_the_mean_over_the_plant_steps():
    env = CrazyflieTrack(Circle(), dtype=torch.float64, start="rest")
    after = act(env, env.reset(), [0.0, 0.0, 0.0, 0.0])
    time = torch.arange(1, 26, dtype=torch.float64) * 0.002
    wanted = Circle().at(time + 0.002)[:, :3]
    fallen = torch.tensor([2.0, 0, 0]) - torch.tensor([0, 0, 1.0]) * (9.81 / 2 * time[:, None] ** 2)
    expected = (wanted - fallen).square().mean(0)
    torch.testing.assert_close(after["square_error"], expected, rtol=1e-6, atol=1e-15)
    torch.testing.assert_close(after["reward"], -expected.sum(0, keepdim=True))


def test_the_mass_changes_at_two_and_at_five_seconds():
    env = CrazyflieTrack(Hover(), dtype=torch.float64, limit=1e3)
    mission = env.mission(regime=[{}, {"mass": 0.5}, {"mass": 4 / 3}])
    record = drive(env, env.reset(mission, set_state=False), [HOVER] * 160)
    column = env.regime.names.index("mass")
    start = env.reset(mission, set_state=False)["regime"][None, column]
    factors = torch.cat([start, record["regime"][:-1, column]])  # of the step that they act in
    expected = torch.ones(160, dtype=torch.float64)
    expected[40:100], expected[100:] = 0.5, 4 / 3
    torch.testing.assert_close(factors, expected)
    lift = record["pose"][:, 5].diff(prepend=torch.zeros(1)) / 0.05 / 9.81
    torch.testing.assert_close(lift, 1 / expected - 1, rtol=1e-6, atol=1e-9)
    assert record["truncated"].flatten().tolist() == [False] * 159 + [True]
    assert not record["terminated"].any()


def test_wind_is_an_acceleration():
    env = CrazyflieTrack(Hover(), dtype=torch.float64, schedule=Schedule([], by="step"))
    mission = env.mission(regime={"wind_x": 0.5, "wind_z": -1.0})
    last = drive(env, env.reset(mission, set_state=False), [HOVER] * 20)[-1]
    expected = torch.tensor([0.25, 0, -0.5, 0.5, 0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(last["pose"][:6], expected)


@pytest.mark.parametrize("schedule", [[0.1, 0.3], Schedule([0.2, 0.8])])
def test_missions_have_times_of_their_own(schedule):
    env = CrazyflieTrack(Hover(), duration=0.5, schedule=schedule)
    changes = [{}, {"mass": 0.5}, {}]
    missions = [
        env.mission(regime=changes, times=times) for times in (None, [0.25, 0.4], [0.21, 0.26])
    ]
    record = drive(env, env.reset(torch.stack(missions), set_state=False), [HOVER] * 9)
    # what is seen after step k holds for step k + 1
    begun = record["regime_active"][:, 1:].T.tolist()
    assert begun[0] == [k + 1 in (5, 6, 7) for k in range(9)]
    assert begun[1] == [k + 1 in (5,) for k in range(9)]


@pytest.mark.parametrize("action", [[0.575, 0, 0, 0], [0.3, 6.6e-3, -6.6e-3, 9e-4]])
def test_a_lost_flight_terminates_and_stays_finite(action):
    env = CrazyflieTrack(Hover(), limit=1.0, trace=True, substeps=5)
    record = drive(env, env.reset(), [action] * 60)
    ended = record["terminated"].flatten()
    first = int(ended.int().argmax())
    assert 0 < first < 50
    assert ended[first:].all() and record["done"].flatten()[first:].all()
    assert record["pose"].isfinite().all() and record["square_error"].isfinite().all()
    assert (record["pose"][first:] == record["pose"][first - 1]).all()
    assert (record["trace"][first:] == record["pose"][first - 1]).all()
    assert record["pose"][:, :3].norm(dim=-1).max() <= 1.0
    assert not record["lost"][:first].any()


def test_numbers_without_end_terminate(monkeypatch):
    env = CrazyflieTrack(Hover(), regime=ActionGain(["a", "b", "c", "d"]), schedule=[])
    monkeypatch.setattr(env.regime, "limits", {})
    missions = torch.stack([env.mission(regime={"b": value}) for value in (1.0, 1e30)])
    record = drive(env, env.reset(missions, set_state=False), [[0.3, 1e-3, 0, 0]] * 3)
    assert record["terminated"][..., 0].tolist() == [[False, True]] * 3
    assert record["pose"].isfinite().all() and record["reward"].isfinite().all()


class Halfway(Reference):
    """A reference that forgot the velocity."""

    name = "halfway"

    def at(self, time):
        return torch.zeros(*time.shape, 3)


@refused(
    ({"action_low": [0.0]}, r"action_low=\[0.0\]: expected numbers for .*thrust"),
    ({"tracks": Halfway()}, r"halfway: at\(\) gives \(2, 3\).*position and velocity"),
    ({"schedule": [5.0, 2.0]}, r"times=\[5.0, 2.0\]: expected increasing"),
    ({"duration": 0.12}, "duration=0.12: expected a multiple of dt=0.05"),
    ({"sensor_noise": [0.1, 0.2]}, "expected one number, or four"),
    ({"missions": {"times": [5.0], "at": [3]}}, "expected one"),
)
def test_impossible_settings_are_refused(settings):
    CrazyflieTrack(**settings)


@pytest.mark.parametrize("regime", [None, MassFactor()])
def test_impossible_parameters_in_a_tensordict_are_refused(regime):
    env = CrazyflieTrack(regime=regime)
    mission = env.mission(regime={"mass": 0.5})
    mission["mission", "parameters"][1, env.regime.names.index("mass")] = -0.5
    with pytest.raises(ConfigurationError, match=r"mass=-0.5: expected a number in \[0.01, 100\]"):
        env.reset(mission, set_state=False)


@refused(
    (0, float("nan"), "expected 13 finite numbers"),
    (4, float("inf"), "expected 13 finite numbers"),
    (9, 2.0, r"quaternions of flights \[1\]: length 2, expected 1"),
)
def test_impossible_states_are_refused(column, value):
    env = CrazyflieTrack()
    data = env.reset(TensorDict(batch_size=[3]))
    data["pose"][1, column] = value
    env.reset(data, set_state=True)
