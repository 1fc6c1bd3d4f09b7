"""Logs as people have them, and the verdict that is right: units, hover, neighbours, grippers."""

import re

import numpy as np
import pytest
from simulate import explain, log_of, said, servo, steps

from afm_rl.diagnosis import Log, diagnose, verdict


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 6])
@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (10.0, "10 times the command"),
        (9.0, "9 times the command"),
        (0.1, "10 % of the command"),
        (2.0, "200 % of the command"),
    ],
)
def test_a_unit_is_not_assumed_where_the_interval_excludes_it(size, factor, words):
    u = np.random.default_rng(0).uniform(-1, 1, (400, size))
    log = log_of(u, factor * u, scale=0.02 * min(factor, 1.0))
    found = diagnose(log)
    assert {a.status for a in found.actuators} == {"changed"} and not found.notes
    assert all(a.sentence.endswith(words) for a in found.actuators)
    of_the_wrapper = explain(u[-200:], log.response[-200:], names=log.names)
    assert [a.status for a in of_the_wrapper.actuators] == ["changed"] * size
    assert all(words.split()[1] in a.sentence for a in of_the_wrapper.actuators)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (180 / np.pi, "all responses are in degrees for radians: 57.3"),
        (30 / np.pi, "all responses are in rpm for rad/s: 9.549"),
        (0.001, "all responses are in m for mm: 0.001"),
    ],
)
def test_a_unit_that_is_assumed_is_said(factor, words):
    for seed, size in ((0, 1), (1, 4)):
        u = np.random.default_rng(seed).uniform(-1, 1, (400, size))
        log = log_of(u, factor * u, None, 0.005 * factor, seed)
        for found in (diagnose(log), explain(u, log.response)):
            assert found.healthy and found.common[0].startswith(words) and words in str(found)


@pytest.mark.parametrize(
    ("factor", "zero", "weak"),
    [(4096 / (2 * np.pi), 2048, 0.6), (4096 / (2 * np.pi), 0, 1), (8000, 0, 0.6), (100, 0, 0.8)],
)
def test_a_unit_that_all_share_is_said_once(factor, zero, weak):
    for seed, size in ((0, 4), (1, 3)):
        u = steps(seed, 500, size, low=-1.0 if zero else 0.0)
        gains = np.where(np.arange(size) == 2, weak, 1.0)
        y, scale = zero + factor * gains * u, 0.005 * factor
        log = log_of(u, y, None, scale, seed, units=("rad", "ticks"))
        found = diagnose(log)
        (note,) = found.notes
        assert note.startswith("all responses are in another unit: ")
        assert "ticks per rad" in note and (", counted from 20" in note) is bool(zero)
        assert found.actuators[0].unit == pytest.approx(factor, rel=0.01)
        others = [a.status for a in found.actuators if a.name != "joint_2"]
        assert others == ["healthy"] * (size - 1)
        words = "healthy" if weak == 1 else f"{100 * weak:.0f} % of the command"
        assert found.actuators[2].sentence == f"joint_2: {words}"


def test_what_all_reach_alike_is_no_unit():
    u = steps(0, 600, 4)
    assert said(log_of(u, 0.62 * u, scale=0.005)) == 4 * ["62 % of the command"]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("moves", [0.0007, 0.0015])
def test_what_is_hardly_excited_cannot_be_told(seed, moves):
    """Set-points that hardly move, and responses that wander by noise."""
    rng = np.random.default_rng(seed)
    u = np.cumsum(moves * rng.standard_normal((214, 2)), axis=0) * 0.3
    drift = np.cumsum(rng.standard_normal((214, 2)), axis=0)
    y = u + 0.011 * (drift / drift.std(0) + 0.3 * rng.standard_normal((214, 2)))
    for actuator in diagnose(log_of(u, y, scale=0.0, t=0.104 * np.arange(214))).actuators:
        assert actuator.status == "cannot tell"


def hover(seed, dt=0.02, lag=0.04, stiff=1.5, gust=0.3, noise=0.02, rows=600):
    """Return set-points of a speed by a position loop that holds, and the speed."""
    rng, position, speed, wind, table = np.random.default_rng(seed), 0.0, 0.0, 0.0, []
    for _ in range(rows):
        setpoint = -stiff * (position + 0.01 * rng.standard_normal())
        table.append((setpoint, speed + noise * rng.standard_normal()))
        wind = 0.95 * wind + 0.3 * gust * rng.standard_normal()
        speed += (1 - np.exp(-dt / lag)) * (setpoint + wind - speed)
        position += speed * dt
    return np.array(table).T


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "how",
    [
        {},
        {"gust": 0.05},
        {"dt": 0.1, "stiff": 1},
        {"dt": 0.01, "stiff": 3},
        {"gust": 0, "lag": 0.1},
    ],
)
def test_a_loop_that_hovers_is_actuated(seed, how):
    u, y = hover(seed, **how)
    t = how.get("dt", 0.02) * np.arange(600)
    (actuator,) = diagnose(log_of(u, y, scale=0.0, t=t)).actuators
    assert actuator.status == "cannot tell" or actuator.gain == pytest.approx(1, abs=0.35)
    assert actuator.status != "not actuated" and "no known fault" not in actuator.sentence


def like(seed, kind, rows=300):
    """Return commands of three servos that are commanded alike, or by different amounts."""
    u = 500 * steps(seed, rows, 3)
    if kind == "amounts":
        return u * [1.0, 0.2, 0.05]
    if kind == "one after the other":
        return np.column_stack([np.roll(u[:, 0], j) for j in range(3)])
    return u if kind == "own" else u[:, [0]] + 0.05 * u


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["own", "alike", "amounts", "one after the other"])
@pytest.mark.parametrize(("rate", "delay", "share"), [(180.0, 2, 1.0), (90.0, 0, 0.5)])
def test_beside_others_nothing_is_blurred(kind, rate, delay, share):
    u = like(9, kind)
    y = servo(u, rate, delay, share) + np.random.default_rng(1).standard_normal(u.shape)
    names = tuple(f"servo_{j}" for j in range(3))
    together = diagnose(Log(names, u, y)).actuators
    for j in (0, 2):
        (alone,) = diagnose(Log(names[j : j + 1], u[:, [j]], y[:, [j]])).actuators
        beside = together[j]
        assert beside.gain == pytest.approx(alone.gain, abs=0.03)
        widths = [np.ptp(a.gain_interval) for a in (alone, beside)]
        assert widths[1] < 1.5 * widths[0] + 0.02
        assert alone.rate is None or beside.rate == pytest.approx(alone.rate, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("low", "high", "answer", "words"),
    [
        (0, 100, lambda u: 100 - u, r"reversed about its middle \(\d\d[.\d]*\)"),
        (0, 1, lambda u: 1 - u, r"reversed about its middle \(0.\d+\)"),
        (1, 2, lambda u: 3 - u, r"reversed about its middle \(1.\d+\)"),
        (0, 100, lambda u: 120 - u, r"reversed, offset \+.* \((19|20|21) % of its range\) at .*"),
        (0, 100, lambda u: -u, "reversed"),
        (0, 100, lambda u: 0.6 * u, "60 % of the command"),
        (0, 100, lambda u: 20 + 0.6 * u, "60 % of the moves of its command"),
        (0, 100, lambda u: u + 15, r"offset \+15(\.\d)? \(1\d % of its range\)"),
        (-1, 1, lambda u: 0.3 - u, r"reversed, offset \+0.\d* \(1\d % of its range\)"),
        (0, 100, lambda u: u, "healthy"),
    ],
)  # fmt: skip
def test_grippers_are_reversed_about_their_middle(seed, low, high, answer, words):
    u = steps(seed, 720, hold=12, low=low, high=high)
    log = log_of(u, answer(u), None, 0.004 * (high - low), seed)
    (actuator,) = diagnose(log).actuators
    pairs = slice(0, 720, 12)
    (shown,) = explain(u[pairs], log.response[pairs], names=log.names).actuators
    for found in (actuator, shown):
        assert re.fullmatch(f"joint_0: {words}", found.sentence), found.sentence


def pulses(seed, rows, hold, top, kind):
    """Return commands that are 0 but for pulses, of any size, of one size, or to one side."""
    rng, u, k = np.random.default_rng(seed), np.zeros((rows, 1)), 10
    while k < rows - 20:
        size = {"any": rng.uniform(-1, 1), "one size": rng.choice([-1, 1]), "one side": 1.0}[kind]
        u[k : k + hold] = top * size
        k += hold + int(rng.integers(5, 25))
    return u


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["any", "one size", "one side", "steps"])
@pytest.mark.parametrize(("hold", "top", "delay"), [(5, 900.0, 2), (5, 1500.0, 0), (8, 2160.0, 4)])
def test_pulses_show_a_limited_rate(kind, hold, top, delay):
    u = top * steps(0, 600, hold=hold) if kind == "steps" else pulses(0, 600, hold, top, kind)
    (actuator,) = diagnose(log_of(u, servo(u, 180.0, delay), scale=4.0)).actuators
    assert actuator.gain == pytest.approx(1, abs=0.03)
    assert actuator.rate == pytest.approx(180, rel=0.05)
    assert actuator.delay_s + actuator.lag_s == pytest.approx(delay, abs=0.6)
    assert "takes over" not in actuator.sentence and "known" not in actuator.sentence


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize(("hold", "rate"), [(10, 0.05), (20, 0.02), (30, 0.1), (4, 0.15)])
def test_a_servo_in_a_hurry_is_no_sum(seed, scale, hold, rate):
    u = steps(seed, 900, hold=hold)
    y = servo(u, rate, 1)
    (position,) = diagnose(log_of(scale * u, scale * y, scale=0.01 * scale)).actuators
    assert "added up" not in position.sentence
    assert position.rate == pytest.approx(scale * rate, rel=0.06)
    sums = np.cumsum(rate * u, axis=0)
    (speed,) = diagnose(log_of(scale * u, scale * sums, scale=0.01 * scale * sums.std())).actuators
    assert speed.status == "cannot tell"
    assert speed.sentence.endswith("added up its command; log its rate of change")


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "every"), [(250, 2), (400, 3), (500, 4)])
@pytest.mark.parametrize("held", [1, 4])
def test_a_delay_does_not_depend_on_which_rows_are_used(held, rate, every, monkeypatch):
    """Of a quick logger every second row, or fewer, are used, unless commands step between them."""
    late, seconds = 3, np.arange(2000) / rate
    tones = [np.sin(2 * np.pi * f * seconds + p) for f, p in ((0.7, 0.0), (2.9, 1.0), (4.3, 2.0))]
    u = np.repeat(np.mean(tones, 0)[::held], held)[: len(seconds), None]
    y = np.concatenate([np.repeat(u[:1], late, 0), u[:-late]])
    y = y + 0.01 * np.random.default_rng(0).standard_normal(u.shape)
    log = Log(("joint",), u, y, t=seconds)
    found = diagnose(log)
    note = f"one of {every} rows is used: the others add nothing"
    assert (note in found.notes) == (held == 1)
    monkeypatch.setattr(verdict, "rows_enough", lambda log, settings: np.arange(len(log)))
    for (joint,) in (found.actuators, diagnose(log).actuators):
        assert joint.delay_s == pytest.approx(late / rate, abs=0.1 / rate)
        assert joint.time_interval == pytest.approx((late / rate, late / rate), abs=0.3 / rate)
