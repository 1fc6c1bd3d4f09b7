"""A diagnosis from logs of a simulator that knows what is wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest
from harness import refused
from simulate import Fault, commands, noise, respond, servo

from afm_rl.diagnosis import Log, diagnose

NAMES = ("base", "shoulder", "elbow", "wrist", "roll", "gripper", "finger", *"hijklmn")


def log_of(faults, rows=900, kind="smooth", scale=0.02, sort="gauss", seed=0, later=None, **how):
    """Return the log of some actuators; from 60 % on ``later`` holds."""
    rng = np.random.default_rng(seed)
    u = commands(rng, rows, len(faults), kind)
    y = np.column_stack([respond(u, fault, j) for j, fault in enumerate(faults)])
    if later:
        after = np.column_stack([respond(u, fault, j) for j, fault in enumerate(later)])
        y[int(0.6 * rows) :] = after[int(0.6 * rows) :]
    y += noise(rng, rows, len(faults), scale, sort)
    return Log(NAMES[: len(faults)], u, y, **how)


def test_each_fault_is_named():
    faults = [
        Fault(),
        Fault(gain=-0.62, delay=2),
        Fault(dead_zone=0.2, offset=0.3),
        Fault(saturation=0.5, lag=3),
        Fault(source=5),
        Fault(source=4),
        Fault(coupling=(0, 0.4), backlash=0.2),
    ]
    found = diagnose(log_of(faults, 600, "walk", t=0.02 * np.arange(600)))
    said = re.sub(r"\d+\.\d+", lambda x: f"{float(x[0]):.1f}", str(found)).splitlines()
    assert said == [
        "base: healthy",
        "shoulder: reversed, 62 % of the command, 2 steps (0.0 s) late",
        "elbow: offset +0.3 (15 % of its range), no motion for commands below 0.2",
        "wrist: no more for commands beyond 0.5, a lag of 3 steps (0.1 s)",
        "roll: follows the command of gripper",
        "gripper: follows the command of roll",
        "finger: takes in +40 % of the command of base, play of 0.4",
    ]
    shoulder, roll = found.actuators[1], found.actuators[4]
    assert shoulder.delay_s == pytest.approx(0.04, abs=0.002) and shoulder.reversed
    assert roll.driven_by == "gripper" and roll.gain == pytest.approx(1, abs=0.02)
    assert found.step_s == pytest.approx(0.02)


def test_what_changes_on_the_way_is_found():
    before = [Fault(), Fault(), Fault(source=3), Fault()]
    after = [Fault(gain=-0.6), Fault(delay=4), Fault(), Fault(gain=0)]
    found = diagnose(log_of(before, 900, "walk", later=after, t=0.1 * np.arange(900)))
    for actuator in found.actuators:
        (change,) = actuator.changes
        assert change.t == pytest.approx(54, abs=1)
    base, shoulder, elbow, wrist = found.actuators
    assert base.sentence == "base: reversed, 60 % of the command, since step 540 (54 s)"
    assert shoulder.sentence.startswith("shoulder: 4 steps (0.4 s) late, since step ")
    told = "follows the command of wrist until step 540 (54 s), healthy since"
    assert elbow.sentence == f"elbow: {told}"
    assert wrist.status == "dead"


def test_what_changes_and_comes_back_is_found():
    log = log_of([Fault()] * 2, 600, "walk")
    y = log.response.copy()
    y[200:400, 0] *= -1
    first, second = diagnose(replace(log, response=y)).actuators
    assert [change.t for change in first.changes] == pytest.approx([200, 400], abs=2)
    assert first.gain == pytest.approx(1, abs=0.03) and second.status == "healthy"


def test_a_drift_is_no_sudden_change():
    (actuator,) = diagnose(log_of([Fault(drift=0.5)])).actuators
    assert not actuator.changes and actuator.status == "changed"
    assert actuator.drift["offset"] == pytest.approx((0, 0.5), abs=0.02)


def test_the_log_cannot_tell():
    log = log_of([Fault()] * 4, 300)
    u, y = log.command.copy(), log.response.copy()
    u[:, 0] = 0.0  # constant
    u[:, 2] = -2 * u[:, 1]  # the same command twice
    y[:, 3] += 5 * np.random.default_rng(0).standard_normal(300)  # nothing but noise
    found = diagnose(replace(log, command=u, response=y)).actuators
    assert [a.status for a in found] == ["cannot tell", "healthy", "cannot tell", "cannot tell"]
    assert found[0].sentence == "base: cannot tell: its command does not change; move it"


def test_a_dead_actuator():
    log = log_of([Fault(), Fault(gain=0.0)])
    quiet = log.with_column("response", 0, 0.25 + 1e-3 * np.sin(np.arange(900)))
    dead = [f"{name}: does not answer its command" for name in NAMES[:2]]
    assert str(diagnose(quiet)).splitlines() == dead


def drop_out(u, rng):
    """Return commands without about a fifth of the rows, at least 12 at a time."""
    begins = rng.random(len(u)) < 0.018
    lost = np.convolve(begins, np.ones(12))[: len(u)] > 0
    return u * ~lost


def gaps(u, rng):
    """Return commands without three in ten rows."""
    return u * (rng.random(len(u)) < 0.7)


def stick(u, rng):
    """Return what moves only where the command is farther away than 0.2."""
    places = [u[0]]
    for value in u[1:]:
        places.append(value if abs(value - places[-1]) > 0.2 else places[-1])
    return np.array(places)


def wrap(y, turn):
    return (y + turn / 2) % turn - turn / 2


ODD = {
    r"sticks for changes below (0.19\d*|0.2|0.20\d*)": stick,
    "100 % of positive commands, 50 % of negative ones": lambda u, rng: np.where(u > 0, u, u / 2),
    r"does not follow in (1\d|2\d|3\d) % of the rows, \d\d % of its motion unexplained": drop_out,
    r"does not follow in (2\d|3\d) % of the rows, (2|3|4)\d % of its motion unexplained": gaps,
    "57.3 times the command: degrees for radians": lambda u, rng: np.degrees(u),
    r"gain drifts from (1|0.99\d?|1.0\d?) to (0.5|0.49\d?|0.50\d?)": (
        lambda u, rng: u * np.linspace(1, 0.5, len(u))
    ),
    r"no faster than (0\.1|0\.09\d+|0\.10\d+) per row": lambda u, rng: servo(u, 0.1),
    "takes over one of 4 commands only": lambda u, rng: u[np.arange(len(u)) // 4 * 4],
    "answers 3 steps before its command in the log": lambda u, rng: np.roll(u, -3),
    r"reversed, offset \+2\.[789]\d*": (lambda u, rng: wrap(2.8 - u, 2 * np.pi)),
    "switches between two responses, whatever the size of its command": lambda u, rng: np.sign(u),
    r"reversed, since step (597|598|599|600|601|602|603)": (
        lambda u, rng: u * np.where(np.arange(len(u)) < 600, 1, -1)
    ),
}


@pytest.mark.slow
def test_faults_that_are_no_number_of_the_model_have_words():
    log = log_of([Fault()] * (1 + len(ODD)), 800, "walk", scale=0.0, seed=5)
    rng, y = np.random.default_rng(5), log.response.copy()
    for j, make in enumerate(ODD.values()):
        y[:, j] = make(log.command[:, j], rng)
    y += 0.02 * rng.standard_normal(y.shape)
    *found, last = diagnose(replace(log, response=y)).actuators
    for words, actuator in zip(ODD, found, strict=True):
        assert re.fullmatch(words, actuator.sentence.partition(": ")[2]), actuator.sentence
    assert last.status == "healthy"


UNKNOWN = {
    "it depends on other commands": lambda u, rng: u[:, 0] * u[:, 1],
    "it depends on earlier commands": lambda u, rng: np.diff(u[:, 0], prepend=0),
    "as if its gain varied": lambda u, rng: u[:, 0] * rng.choice([-1, 1], len(u)),
}


@pytest.mark.parametrize("kind", ["white", "walk"])
def test_a_fault_that_is_not_known_is_called_so(kind):
    log = log_of([Fault()] * 5, 800, kind, seed=5)
    y = log.response.copy()
    for j, make in enumerate(UNKNOWN.values()):
        y[:, j] = make(log.command[:, [j, 4]], np.random.default_rng(5))
    found = diagnose(replace(log, response=y)).actuators
    for words, actuator in zip(UNKNOWN, found, strict=False):
        if kind == "walk" or "earlier" not in words:  # of white noise half of that is the command
            assert "no known fault: " in actuator.sentence and words in actuator.sentence
            assert actuator.unexplained > 0.5
    assert [a.status for a in found] == ["changed"] * 3 + ["healthy"] * 2


def test_what_the_numbers_leave_is_told():
    log, rng = log_of([Fault()] * 4, 1200, "smooth"), np.random.default_rng(0)
    u, y, rows = log.command, log.response.copy(), np.arange(1200)
    y[:, 0] = np.interp(rows - rng.uniform(0, 8, 1200), rows, u[:, 0])
    y[:, 1] += 0.2 * np.sin(2 * np.pi * rows / 400)
    y[:, 2] += 0.3 * rng.standard_normal(1200)
    late, wandering, noisy, quiet = diagnose(replace(log, response=y)).actuators
    assert late.sentence.endswith("as if its delay varied)") and late.delay_s + late.lag_s > 1.5
    assert wandering.status == "changed" and "depends on the time" in wandering.sentence
    assert re.fullmatch(r"elbow: healthy, 2\d % of its motion unexplained", noisy.sentence)
    assert quiet.sentence == "wrist: healthy"


def test_joints_that_turn_all_round_are_healthy():
    log = log_of([Fault()] * 2, 800, "walk")
    turn = np.cumsum(0.1 + 0.2 * log.command[:, 0])
    u, y = log.command.copy(), log.response.copy()
    u[:, 0], y[:, 0] = wrap(40 * turn, 360.0), wrap(40 * turn + 0.2 * y[:, 1], 360.0)
    assert diagnose(replace(log, command=u, response=y)).healthy


@pytest.mark.parametrize("side", [1, -1])
def test_commands_of_one_direction_have_a_dead_zone(side):
    log = log_of([Fault()] * 2, 600, "walk")
    u = side * np.abs(log.command)
    y = u + 0.01 * np.random.default_rng(0).standard_normal(u.shape)
    y[:, 0] -= np.clip(u[:, 0], -0.2, 0.2)
    sticky, free = diagnose(replace(log, command=u, response=y)).actuators
    assert re.fullmatch(r"base: no motion for commands below 0\.(2|19\d*|20\d*)", sticky.sentence)
    assert sticky.saturation is None and free.status == "healthy"


def test_time_need_not_be_even():
    rng = np.random.default_rng(0)
    fine = np.arange(0, 20, 0.001)
    u = np.column_stack([np.sin(2.1 * fine) + np.sin(5.3 * fine + k) for k in range(2)])
    late = np.column_stack([-0.7 * np.interp(fine - 0.05, fine, u[:, 0]), u[:, 1]])
    t = np.cumsum(rng.uniform(0.01, 0.03, 900))
    t = np.delete(t, rng.integers(0, 900, 50))  # lost rows
    rows = np.searchsorted(fine, t)
    y = late[rows] + 0.02 * rng.standard_normal((len(t), 2))
    base, shoulder = diagnose(Log(NAMES[:2], u[rows], y, t)).actuators
    assert base.reversed and base.delay_s == pytest.approx(0.05, abs=0.005)
    assert shoulder.status == "healthy"


def test_nothing_is_taken_across_the_border_of_an_episode():
    log = log_of([Fault(delay=3), Fault(delay=6)], 1000, "steps")
    u, y, episode = log.command.copy(), log.response.copy(), np.arange(1000) // 50
    for first in range(0, 1000, 50):  # each begins at rest
        y[first : first + 3, 0], y[first : first + 6, 1] = u[first]
    found = diagnose(replace(log, command=u, response=y, episode=episode)).actuators
    assert [a.sentence[-12:] for a in found] == ["3 steps late", "6 steps late"]
    assert all(a.noise < 0.03 for a in found)


def test_a_healthy_delay_is_no_fault():
    log = log_of([Fault(delay=2), Fault(delay=6)])
    first, second = diagnose(replace(log, usual_delay=2.0)).actuators
    assert first.status == "healthy" and first.delay_s == pytest.approx(2, abs=0.1)
    assert second.sentence == "shoulder: 6 steps late"


def test_outliers_and_a_coarse_sensor_do_not_matter():
    log = log_of([Fault(gain=-0.8), Fault(quantum=0.05), Fault()], scale=0.01)
    y = log.response.copy()
    y[::50, 0] = 40.0
    y[:, 2] = np.round(y[:, 2] / 0.25) * 0.25
    first, second, coarse = diagnose(replace(log, response=y)).actuators
    assert first.gain == pytest.approx(-0.8, abs=0.02)
    assert second.status == "healthy" and second.quantum < 0.1
    assert coarse.sentence == "elbow: moves in steps of 0.25" and coarse.dead_zone > 0


@pytest.mark.slow
def test_long_logs_of_seven_joints():
    log = log_of([Fault(), Fault(gain=-0.5)] * 3 + [Fault(delay=2)], 20_000, "white")
    found = diagnose(log)
    assert [a.status for a in found.actuators] == ["healthy", "changed"] * 3 + ["changed"]


@refused(
    ({"command": np.zeros((30, 2))}, "expected 1 columns"),
    ({"command": np.zeros((5, 1)), "response": np.zeros((5, 1))}, "at least 20"),
    ({"response": np.full((30, 1), np.nan)}, "not finite"),
    ({"t": np.zeros(30)}, "t does not increase"),
)
def test_logs_that_cannot_be_used(change):
    parts = {"names": ("a",), "command": np.zeros((30, 1)), "response": np.zeros((30, 1))}
    Log(**(parts | change))
