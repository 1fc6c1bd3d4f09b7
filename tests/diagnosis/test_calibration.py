"""A diagnosis that is written back: numbers, commands that make up for them, and a model."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from simulate import servo, steps

from afm_rl.diagnosis import (
    Log,
    apply,
    calibrate,
    diagnose,
    known_dynamics,
    predict,
    read_calibration,
)
from afm_rl.errors import ConfigurationError

STEP = 0.02
NOISE = 0.005


def robot(command, gain, offset, delay=(), share=(), zone=(), noise=0.0):
    """Return the responses of joints: gains, offsets, delays (rows), first-order gains, zones."""
    size, rng = len(offset), np.random.default_rng(1)
    delay, zone = delay or [0] * size, np.array(zone or [0.0] * size)
    share, y = np.array(share or [1.0] * size), np.zeros((len(command) + 1, size))
    y[0] = offset
    for k in range(len(command)):
        u = np.array([command[max(k - late, 0), j] for j, late in enumerate(delay)])
        inner = np.sign(u) * np.maximum(np.abs(u) - zone, 0)
        y[k + 1] = y[k] + share * (np.atleast_2d(gain) @ inner + offset - y[k])
    return y[1:] + noise * rng.standard_normal(command.shape)


ROBOTS = {
    "healthy": ([[1.0]], [0.0]),
    "sign": ([[-1.0]], [0.0]),
    "all": (np.diag([-0.6, 1.3, 0.8]), [0.2, -0.1, 0.0], [3, 0, 1], [1.0, 0.3, 1.0], [0, 0.1, 0]),
    "swapped": ([[0.0, 1.0], [-0.7, 0.0]], [0.0, 0.2]),
    "coupled": ([[1.0, 0.0], [0.3, 0.8]], [0.1, 0.0]),
}


def logged(name, **changes):
    command = steps(0, 900, len(ROBOTS[name][1]), 3)
    response = robot(command, *ROBOTS[name], noise=NOISE)
    names = tuple("abc"[: command.shape[1]])
    return Log(names, command, response, t=STEP * np.arange(len(command)), **changes)


@cache
def calibrated(name):
    return calibrate(logged(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_a_log_a_calibration_a_corrected_command_and_a_robot_that_obeys(name):
    log, calibration = logged(name), calibrated(name)
    way = steps(2, 900, len(log.names), 12, -0.4, 0.4)
    corrected = apply(calibration, way, ahead=True)
    moved = robot(corrected, *ROBOTS[name])
    np.testing.assert_allclose(moved[12:-12], way[12:-12], atol=0.02)
    again = Log(log.names, way, moved + NOISE * np.random.default_rng(3).standard_normal(way.shape))
    assert diagnose(again).healthy
    if name == "healthy":
        np.testing.assert_array_equal(corrected, way)


def test_one_command_is_corrected_at_a_time():
    calibration, way = calibrated("all"), steps(2, 900, 3, 30, -0.4, 0.4)
    moved = robot(np.array([apply(calibration, u) for u in way]), *ROBOTS["all"])
    np.testing.assert_allclose(moved[29::30], way[29::30], atol=0.02)
    assert apply(calibration, np.zeros((2, 5, 3))).shape == (2, 5, 3)


def test_the_numbers_are_those_of_the_robot():
    a, b, c = calibrated("all").joints
    found = {"sign": [-1, 1, 1], "scale": [0.6, 1.3, 0.8], "offset": [0.2, -0.1, 0.0]}
    found |= {"dead_zone": [0.0, 0.1, 0.0], "delay": [0.06, 0.0, 0.02]}
    found |= {"lag": [0.0, -STEP / np.log(0.7), 0.0]}
    for number, truth in found.items():
        for joint, true in zip((a, b, c), truth, strict=True):
            estimate = getattr(joint, number)
            low, high = estimate.interval
            assert estimate.determined and low <= estimate.value <= high
            assert estimate.value == pytest.approx(true, abs=2e-3)
    assert all(joint.rate.value == np.inf and not joint.rate.determined for joint in (a, b, c))
    assert a.undo == f"(u - {a.offset.value:.6g}) / -{a.scale.value:.6g}, 0.06 s earlier"
    assert "more in its direction" in b.undo and c.undo.endswith(", 0.02 s earlier")


@pytest.mark.parametrize(
    ("reach", "offset", "effect", "undo"),
    [
        (1.0, 0.0, lambda u: u, "u"),
        (1.0, 0.0, lambda u: -u, "-u"),
        (90.0, 0.0, np.radians, "u"),  # degrees in, radians out
        (50.0, 50.0, lambda u: 100 - u, "-(u - 100)"),  # a gripper
        (50.0, 100.0, lambda u: u + 7, "(u - 7)"),
        (1.0, 0.0, lambda u: np.where(u > 0, 0.5 * u, u), "u / 0.5; negative ones by 1"),
        (1.0, 0.0, lambda u: 0.5 * u.clip(-0.6, 0.6), "u / 0.5"),
    ],
)
def test_what_would_undo_it_in_words_and_numbers(reach, offset, effect, undo):
    u = offset + reach * np.round(steps(0, 900, hold=3), 2)
    size = np.ptp(effect(u))
    noise = 1e-4 * size * np.random.default_rng(0).standard_normal(u.shape)
    log = Log(("a",), u, effect(u) + noise)
    (joint,) = calibrate(log).joints
    rounded = re.sub(r"[\d.]+", lambda number: f"{round(float(number[0]), 2):g}", joint.undo)
    assert rounded == undo
    way = offset + 0.25 * reach * steps(2, 900, hold=3)
    moved = effect(apply(calibrate(log), way))
    np.testing.assert_allclose(moved, joint.unit * way, atol=0.01 * size)


def test_a_rate_limit_is_in_units_of_the_response():
    u = steps(0, 900, hold=30) * 100
    y = servo(-0.5 * u, 8)
    y += 0.1 * np.random.default_rng(1).standard_normal(y.shape)
    (joint,) = calibrate(Log(("a",), u, y, t=STEP * np.arange(900))).joints
    low, high = joint.rate.interval
    assert joint.rate.determined and low < 8 / STEP < high and high - low < 0.1 * high


def test_what_cannot_be_told_is_not_determined_and_its_command_stays(tmp_path):
    u = np.column_stack([steps(0, 900, hold=3), steps(1, 900, hold=3), np.zeros(900)])
    noise = NOISE * np.random.default_rng(0).standard_normal(u.shape)
    log = Log(("a", "dead", "still"), u, u * [-1, 0, 0] + noise)
    calibration = calibrate(log)
    assert [joint.usable for joint in calibration.joints] == [True, False, False]
    assert calibration.time == "rows" and calibration.joints[2].status == "cannot tell"
    for number in range(2):
        calibration.write(tmp_path / f"{number}.json")
        calibration = read_calibration(tmp_path / f"{number}.json")
    assert (tmp_path / "0.json").read_bytes() == (tmp_path / "1.json").read_bytes()
    state, action = torch.zeros(3), torch.tensor([0.5, 0.5, 0.5])
    ahead = known_dynamics(calibration)(state, action)
    np.testing.assert_allclose(ahead, [-0.5, 0.0, 0.5], atol=0.01)  # what is unknown is healthy
    assert np.abs(predict(calibration, log) - log.response).max() < 5 * NOISE
    for joint in calibration.joints[1:]:
        assert not joint.scale.determined and joint.undo == f"nothing: {joint.status}"
    np.testing.assert_allclose(apply(calibration, [0.5, 0.5, 0.5]), [-0.5, 0.5, 0.5], atol=0.01)


def test_the_model_and_the_predictions_are_those_of_the_log():
    log, calibration = logged("all"), calibrated("all")
    assert calibration.delay_steps == [3, 0, 1]
    miss = log.response - predict(calibration, log)
    assert (miss[20:].std(0) < 1.1 * NOISE).all()
    model, rows = known_dynamics(calibration), np.arange(20, 899)
    late = np.stack([log.command[rows + 1 - d, j] for j, d in enumerate([3, 0, 1])], -1)
    ahead = model(torch.tensor(log.response[rows]), torch.tensor(late)).numpy()
    assert ((log.response[rows + 1] - ahead).std(0) < 1.4 * NOISE).all()
    assert calibrate(replace(log, usual_delay=STEP)).delay_steps == [2, 0, 0]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: "{",
        lambda text: "[]",
        lambda text: text.replace('"version": 1', '"version": 2'),
        lambda text: text.replace('"sign"', '"sing"'),
        lambda text: json.dumps(json.loads(text) | {"more": 1}),
        lambda text: json.dumps(json.loads(text) | {"step": "x"}),
    ],
)
def test_files_that_are_no_calibration(tmp_path, spoil):
    path = tmp_path / "arm.json"
    calibrated("sign").write(path)
    path.write_text(spoil(path.read_text()))
    with pytest.raises(ConfigurationError, match="no calibration, or a damaged one"):
        read_calibration(path)
    with pytest.raises(ConfigurationError, match="No such file"):
        read_calibration(tmp_path / "none.json")


def test_two_joints_on_one_command_cannot_be_undone():
    u = steps(0, 900, 2, 3)
    log = Log(("a", "b"), u, u[:, [0, 0]] + NOISE * steps(1, 900, 2, 3))
    with pytest.raises(ConfigurationError, match="expected a command for each joint"):
        apply(calibrate(log), [0.0, 0.0])
    with pytest.raises(ConfigurationError, match="of 1 numbers, one per joint"):
        apply(calibrated("sign"), [0.0, 0.0])
