"""What a diagnosis must not say, and what it says instead: a rule each, on simulated logs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from simulate import Fault, commands, log_of, respond, said, servo, steps

from afm_rl.diagnosis import Log, diagnose


@pytest.mark.slow
def test_dead_time_ramp_and_limit_are_found_together():
    """Of heavy wheels: each episode is a command of 6 s; the one before is not in the log."""
    u, rows = steps(0, 13 * 120, 2, 120, -16, 16), np.arange(12 * 120)
    y = servo(np.clip(u, -13.4, 13.4), 0.8, 8)
    log = log_of(u[120:], y[120:], scale=0.1, t=0.05 * rows, episode=rows // 120)
    found = diagnose(log)
    for wheel in found.actuators:
        assert wheel.delay_s == pytest.approx(0.4, abs=0.05) and wheel.lag_s < 0.1
        assert wheel.rate == pytest.approx(16, rel=0.1)
        assert wheel.saturation == pytest.approx(13.4, abs=0.3)
        assert wheel.gain == pytest.approx(1, abs=0.03)
        assert wheel.unexplained < 0.03 and wheel.lost == 0 and not wheel.changes
    assert "that is the loop's" in found.notes[0] and "late" not in str(found)


def test_a_delay_of_more_than_a_second_is_found():
    u = commands(0, 1500, 2, "steps")
    y = np.column_stack([respond(u, Fault(delay=d, lag=10), j) for j, d in enumerate([0, 55])])
    slow, slower = diagnose(log_of(u, y, t=0.02 * np.arange(1500))).actuators
    assert slower.delay_s == pytest.approx(1.1, abs=0.02)
    assert slow.delay_s < 0.02 and slow.lag_s == pytest.approx(0.2, rel=0.1)


def test_rows_after_a_jump_are_dynamics_and_rows_at_random_are_lost():
    rng = np.random.default_rng(1)
    u = commands(rng, 1000, 2, "steps")
    slow = respond(u, Fault(lag=3), 0)
    gone = np.where(rng.random(1000) < 0.15, 0.0, u[:, 1])
    first, second = diagnose(log_of(u, np.column_stack([slow, gone]))).actuators
    assert first.lost == 0 and "lag of 3 steps" in first.sentence
    assert second.lost == pytest.approx(0.15, abs=0.03)
    assert second.unexplained > 0.1  # what was left out is not explained


def test_a_delay_that_all_share_is_that_of_the_loop():
    u = commands(0, 600, 5, "walk")
    late = [Fault(delay=d) for d in (4, 4, 5, 5, 14)]
    y = np.column_stack([respond(u, fault, j) for j, fault in enumerate(late)])
    found = diagnose(log_of(u, y, t=0.05 * np.arange(600)))
    assert [a.status for a in found.actuators] == ["healthy"] * 4 + ["changed"]
    assert found.actuators[-1].sentence == "joint_4: 14 steps (0.7 s) late"
    (note,) = found.notes
    assert note.startswith("all actuators are 4 to 5 steps (0.2 to 0.25 s) behind their commands")


def test_one_command_for_all_joints_gives_numbers_with_a_caveat():
    u = commands(0, 600, 1, "smooth") * [1.0, -0.5, 2.0]
    first, second, third = diagnose(log_of(u, u * [1.0, 1.0, -0.5])).actuators
    assert first.status == second.status == "healthy"
    assert first.sentence.endswith("those of 2 others are the same up to a factor)")
    assert third.sentence.startswith("joint_2: reversed, 50 % of the command (if it follows its")


def test_idle_joints_are_not_accused():
    u = commands(0, 600, 4, "walk") * [1, 1, 1, 0.01]
    y = u.copy()
    y[:, 3] *= 0.6  # friction
    words = "cannot tell: its command moves by 1 % of the usual; move it"
    assert said(log_of(u, y, scale=0.002))[3] == words


@pytest.mark.parametrize("late", [0, 1])
def test_an_echo_of_the_command_was_not_measured(late):
    u = commands(0, 600, 2, "walk").astype(np.float32)
    y = np.concatenate([u[:1]] * late + [u[: 600 - late]])
    y[:, 1] += 0.01 * np.random.default_rng(1).standard_normal(600)
    first, second = diagnose(Log(("a", "b"), u, y)).actuators
    assert first.status == "not measured" and second.status in ("healthy", "changed")


def test_commands_that_answer_the_response_move_nothing():
    y = commands(0, 1500, 2, "walk")
    u = -0.8 * np.cumsum(y - y.mean(0), axis=0) * 0.05  # a controller at work on a table
    u = np.concatenate([u[:1]] * 3 + [u[:-3]])
    found = diagnose(log_of(u, y, t=0.01 * np.arange(1500)))
    assert [a.status for a in found.actuators] == ["not actuated"] * 2


def test_motors_at_rest_and_at_their_limit():
    u = commands(0, 600, 2, "walk")
    log = log_of(u, 0.1 * u)
    idle = replace(log, effort={"pwm_0": np.full(600, 900.0), "thrust": np.zeros(600)})
    assert said(idle) == ["not actuated: pwm_0 is 900 all the time; is it armed?"] * 2
    full = replace(log, effort={"pwm_0": np.minimum(np.linspace(0, 2, 600), 1)})
    (note,) = diagnose(full).notes
    assert note == "pwm_0 is at its limit, 1, in 50 % of the rows: no more can be commanded"


def test_take_off_and_landing_are_no_change():
    t = 0.04 * np.arange(750)
    flies = (t > 3) & (t < 24)
    u = np.column_stack([np.sin(2 * t) * flies, 1.0 * flies])
    y = np.column_stack([respond(u[:, :1], Fault(lag=5), 0), respond(u[:, 1:], Fault(lag=15), 0)])
    y[t > 25, 0] += 0.3  # where it came down
    x, z = diagnose(log_of(u, y, ("x", "z"), t=t)).actuators
    assert not x.changes and x.lag_s == pytest.approx(0.2, rel=0.15)
    assert z.status == "cannot tell" and "move" in z.sentence


def test_a_wide_interval_cannot_tell_and_says_what_would():
    rng = np.random.default_rng(3)
    u = commands(rng, 40, 1, "white")
    slip = 0.7 * rng.standard_normal((40, 1))
    (slipping,) = diagnose(Log(("v",), u, 0.4 * u + slip)).actuators
    assert slipping.status == "cannot tell" and "would tell" in slipping.sentence
    low, high = slipping.gain_interval
    assert low < 0.4 < high


def test_units_stand_beside_numbers():
    u = commands(0, 900, 1, "walk")
    y = respond(u, Fault(dead_zone=0.2), 0)[:, None] + 0.3
    (sentence,) = said(log_of(u, y, units=("N m", "N m"), t=0.02 * np.arange(900)))
    offset, zone = sentence.split(", ")
    assert re.fullmatch(r"offset \+0\.3\d* N m \(1\d % of its range\)", offset)
    assert re.fullmatch(r"no motion for commands below 0\.2\d* N m", zone)
