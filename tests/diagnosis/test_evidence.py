"""Nothing is said against the evidence: logs after public reports, their twins, and chance."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulate import Fault, commands, log_of, noise, respond

from afm_rl.diagnosis import Log, apply, calibrate, diagnose
from afm_rl.diagnosis.readers import read_log

CASES = Path(__file__).parent / "cases"
TURN = 360.0


def lagging(u, steps):
    return np.column_stack([respond(u, Fault(lag=steps), j) for j in range(u.shape[1])])


def radians_sent_as_degrees(rng, joint):
    """A driver that takes commands for degrees; what it measures is in radians."""
    u = commands(rng, 500, 3)
    return log_of(u, np.radians(lagging(u, 2)), None, 1e-4, t=0.02 * np.arange(500))


def complement_wrapped(rng, joint):
    """A joint whose controller counts from the other end, and whose sensor ends at a turn."""
    u = 180 + 60 * commands(rng, 600, 3)
    y = lagging(u, 1.5)
    y[:, joint] = TURN - y[:, joint]
    y = (y + 0.3 * rng.standard_normal(y.shape)) % TURN
    return Log(("j1", "j2", "j3"), u, y, 0.05 * np.arange(600))


def steering(rng, joint, both_ways=False):
    """A car whose wheels are off by .06 rad: its rate of turn is v tan(steer + .06) / .33."""
    u, v = 0.15 * commands(rng, 600, 1), 1.2 + 0.1 * commands(rng, 600, 1)
    v = v * np.where(np.arange(600)[:, None] // 7 % 2, -1, 1) if both_ways else v
    side = 1 - 2 * (joint % 2)
    return log_of(u, v * np.tan(u + 0.06 * side) / 0.33, ("steering",), t=0.05 * np.arange(600))


def offset_per_start(rng, joint):
    """A steering wheel that counts from where it was at the start."""
    u = 30 * commands(rng, 840, 1)
    episode = np.arange(840) // 120
    offset = np.array([0, 15, 15, 0, 15, 0, 15.0])[episode] * (1 - 2 * (joint % 2))
    return log_of(u, u + offset[:, None], ("steer_deg",), 0.2, episode=episode)


def never_filled(rng, joint):
    """A field that a driver leaves at zero."""
    u = commands(rng, 400, 3)
    y = u + 0.02 * rng.standard_normal(u.shape)
    y[:, joint] = 0.0
    return Log(("j1", "j2", "j3"), u, y)


def case(name, twin, make, *settings):
    """Return the log of a report, or one of the same kind: other numbers, joints and signs."""
    if twin is None:
        return read_log(CASES / f"{name}.csv")
    return make(np.random.default_rng(7 + twin), 1 + twin, *settings)


def said(log):
    return str(diagnose(log))


SAID = {
    radians_sent_as_degrees: ("radians for degrees: 0.01745", "healthy"),
    complement_wrapped: ("reversed", "healthy"),
    steering: (r"3\.[4-8]\d* times the command, offset [+-]0\.2\d* ", ""),
    offset_per_start: (r"an offset that differs by episode: [+-](15|20|0.*) in ", ""),
    never_filled: ("cannot tell: its response never changes", "healthy"),
}


@pytest.mark.slow
@pytest.mark.parametrize("make", SAID)
@pytest.mark.parametrize("twin", [None, 0, 1])
def test_what_logs_of_public_reports_show(make, twin):
    name = "steering_offset" if make is steering else make.__name__
    log = case(name, twin, make)
    fault, others = SAID[make]
    lines = [line for line in said(log).splitlines() if "that is the loop's" not in line]
    accused = [line for line in lines if re.search(fault, line)]
    assert len(accused) == 1
    assert all(line.endswith(others) for line in lines if line not in accused)


@pytest.mark.parametrize("twin", [None, 0])
def test_units_that_are_told_to_be_equal_are_a_fault(twin):
    log = case("radians_sent_as_degrees", twin, radians_sent_as_degrees)
    assert "0.01745 per unit of the command, or commands are taken for that unit" in said(log)
    told = diagnose(replace(log, units=("rad", "rad")))
    assert {a.status for a in told.actuators} == {"changed"} and "Note: all resp" not in str(told)
    undone = apply(calibrate(replace(log, units=("rad", "rad")), told), np.ones(len(log.names)))
    assert undone == pytest.approx(180 / np.pi, rel=0.01)


@pytest.mark.parametrize("twin", [None, 3, 4])
def test_a_sign_that_follows_the_direction_of_travel_cannot_be_told(twin):
    log = case("steering_both_ways", twin, steering, True)
    (actuator,) = diagnose(log).actuators
    assert actuator.status == "cannot tell" or "no known fault" in actuator.sentence


@pytest.mark.parametrize("twin", [None, 0, 1])
def test_an_offset_that_differs_by_episode_is_not_determined(twin):
    log = case("offset_per_start", twin, offset_per_start)
    (actuator,) = diagnose(log).actuators
    other = -20 if twin is None else (-15, 15)[twin % 2]
    offsets = pytest.approx(sorted((0, other)), abs=0.5)
    assert not actuator.changes and sorted(actuator.offsets.values()) == offsets
    (joint,) = calibrate(log).joints
    assert joint.scale.determined and not joint.offset.determined
    assert joint.scale.value == pytest.approx(1, abs=0.02)


def test_an_offset_of_a_few_rows_without_noise_is_found_exactly():
    for seed in range(4):
        u = commands(seed, 100, 1)
        (actuator,) = diagnose(log_of(u, u + 0.3, scale=0.0)).actuators
        assert actuator.offset == pytest.approx(0.3, abs=1e-6) and actuator.status == "changed"


def test_a_share_of_the_range_is_none_of_a_command_that_hardly_moves():
    u = 0.01 * commands(0, 400, 1)
    log = log_of(u, u + 0.3, scale=1e-4)
    assert re.fullmatch(r"joint_0: offset \+0\.3", said(log))
    known = replace(log, command_bounds=(np.array([-1.0]), np.array([1.0])))
    assert said(known) == "joint_0: offset +0.3 (15 % of its range)"


def loop(seed, late, fault, most, rows=500, noise=0.01):
    """Return a loop that holds two positions, one of them at fault in the last ``late`` rows."""
    rng, place, table = np.random.default_rng(seed), np.zeros(2), []
    aim = 0.3 * commands(rng, rows, 2)
    for row in range(rows):
        u = np.clip(1.2 * (aim[row] - place), -most, most)
        effect = u * [fault if row >= rows - late else 1.0, 1.0]
        table.append((u, effect + noise * rng.standard_normal(2)))
        place = place + 0.3 * effect
    u, y = np.array(table).swapaxes(0, 1)
    return Log(("faulty", "sound"), u, y)


@pytest.mark.parametrize("most", [1.0, 20.0])
@pytest.mark.parametrize("late", [30, 60])
def test_a_change_near_the_end_is_found_where_the_loop_diverges(late, most):
    faulty, sound = diagnose(loop(1, late, -1.0, most)).actuators
    assert faulty.sentence.startswith("faulty: reversed") and sound.status == "healthy"
    assert faulty.changes[-1].t == pytest.approx(500 - late, abs=2)


@pytest.mark.parametrize("late", [4, 8])
def test_what_diverges_in_the_last_rows_is_not_healthy(late):
    faulty, _ = diagnose(loop(1, late, -1.0, 1e6)).actuators
    assert faulty.status != "healthy" or faulty.unexplained < 0.3


KINDS = ("white", "steps", "walk", "smooth")
NOISE = ("gauss", "heavy", "red")


@pytest.mark.slow
def test_no_healthy_joint_is_accused():
    for seed in range(36):
        rng, rows = np.random.default_rng(seed), (80, 200, 500)[seed % 3]
        u = commands(rng, rows, 4, KINDS[seed % 4])
        y = u + noise(rng, rows, 4, (0.005, 0.02, 0.1)[seed // 12 % 3], NOISE[seed // 4 % 3])
        found = diagnose(Log(("a", "b", "c", "d"), u, y)).actuators
        assert not [a.sentence for a in found if a.status not in ("healthy", "cannot tell")], seed


def walk(rng, rows, keep=1.0):
    """Return what wanders through a range of 1."""
    x = np.zeros(rows)
    for row in range(1, rows):
        x[row] = keep * x[row - 1] + rng.standard_normal()
    return x / np.ptp(x)


@pytest.mark.slow
def test_channels_that_nobody_drives_are_not_accused():
    """Commands that creep, or stay, beside responses that drift, rest, or belong to another one."""
    for seed in range(60):
        rng, rows = np.random.default_rng(seed), (100, 300, 800)[seed % 3]
        t, driven = np.linspace(0, 1, rows), commands(rng, rows, 1)[:, 0]
        ramps = [side * t ** rng.uniform(0.5, 2) for side in rng.choice([-1, 1], 2)]
        command = (walk(rng, rows), ramps[0], np.full(rows, 0.3), 1e-3 * walk(rng, rows))
        response = (walk(rng, rows), ramps[1], walk(rng, rows, 0.97), 0.0 * t, 0.3 * driven)
        u = np.column_stack([command[seed % 4], driven])
        y = np.column_stack([response[seed % 5] * rng.choice([0.1, 1]), driven])
        y += 0.003 * rng.standard_normal(y.shape) * (seed % 2)
        alone = seed % 7 < 3
        log = Log(("idle",), u[:, :1], y[:, :1]) if alone else Log(("idle", "driven"), u, y)
        idle, *_ = diagnose(log).actuators
        assert idle.status not in ("changed", "dead"), (seed, idle.sentence)


FAULTS = [
    {"gain": -1.0},
    {"gain": 0.5},
    {"gain": 0.0},
    {"gain": -0.6, "delay": 2},
    {"offset": 0.3},
    {"dead_zone": 0.2},
    {"saturation": 0.4},
    {"delay": 4},
    {"lag": 4},
    {"backlash": 0.2},
    {"source": 1},
    {"coupling": (1, 0.4)},
    {"drift": 0.6},
]


@pytest.mark.slow
def test_faults_that_rows_determine_are_named():
    named = {"changed": 0, "dead": 0, "cannot tell": 0, "healthy": 0}
    for seed, fault in enumerate(4 * FAULTS):
        rng, rows, kind = np.random.default_rng(seed), 600, KINDS[seed // len(FAULTS)]
        u = commands(rng, rows * (1 + (kind == "smooth")), 2, kind)
        y = np.column_stack([respond(u, Fault(**fault), 0), u[:, 1]])
        y += noise(rng, len(u), 2, (0.005, 0.02, 0.05)[seed % 3], NOISE[seed // 5 % 3])
        faulty, sound = diagnose(Log(("a", "b"), u, y)).actuators
        named[faulty.status] += 1
        assert sound.status in ("healthy", "cannot tell"), (seed, sound.sentence)
    assert named["changed"] + named["dead"] >= 0.95 * sum(named.values()), named
