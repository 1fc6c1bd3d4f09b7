"""Leader and follower in LeRobot's data sets: delay, first-order gain, offset, frozen telemetry."""

import numpy as np
import pytest
from formats import data_set_of

from afm_rl.cli import diagnose as command
from afm_rl.diagnosis import calibrate
from afm_rl.diagnosis.readers import read_log


def write(folder, gain, late, offset, joints, seed, quantum=0.0, noise=0.05, episodes=50, odd=5):
    """Write episodes at 30 Hz, ``odd`` ones of them frozen, and return the numbers of these.

    Followers go a share ``gain`` of the way to what leaders did ``late`` frames ago.
    """
    rng, rows_of = np.random.default_rng(seed), []
    frozen = {int(number): k for k, number in enumerate(rng.choice(episodes, odd, replace=False))}
    for episode in range(episodes):
        rows = int(rng.integers(90, 130))
        ways = np.repeat(rng.uniform(-60, 60, (rows // 12 + 2, joints)), 12, axis=0)[: rows + 11]
        smooth = np.hanning(12) / np.hanning(12).sum()
        u = np.stack([np.convolve(way, smooth, "valid") for way in ways.T], -1)
        u[: rows // 4] = u[rows // 4]  # a rest
        u = u.clip(-55, 55)
        y, place = np.empty_like(u), u[0]
        for k in range(len(u)):
            place = place + gain * (u[max(k - late, 0)] - place)
            y[k] = place + offset
        y += noise * rng.standard_normal(y.shape)
        if quantum:
            y = quantum * np.round(y / quantum)
        if episode in frozen:  # from the begin, or on the way
            first = len(y) * frozen[episode] // 12
            y[first:] = y[first]
        rows_of.append((u.astype(np.float32), y.astype(np.float32)))
    names = [f"joint_{k}.pos" for k in range(joints)]
    frames = sum(len(u) for u, _ in rows_of)
    data_set_of(folder, rows_of, names, total_frames=frames, total_episodes=episodes)
    return sorted(frozen)


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot",
    [
        {"gain": 0.25, "late": 4, "offset": -0.98, "joints": 2, "seed": 0},
        {"gain": 0.5, "late": 2, "offset": 3.0, "joints": 1, "seed": 1},
        {"gain": 0.15, "late": 7, "offset": 0.0, "joints": 1, "seed": 2},
        {"gain": 1.0, "late": 1, "offset": -0.98, "joints": 2, "seed": 3, "quantum": 0.09},
    ],
)
def test_followers_of_a_data_set(tmp_path, robot):
    frozen = write(tmp_path, **robot)
    log = read_log(tmp_path)
    note = "responses are frozen while commands move in 5 of 50 episodes, which are left out: "
    assert log.notes[0] == note + ", ".join(map(str, frozen))
    assert log.begins.sum() == 45
    calibration = calibrate(log)
    assert calibration.delay_steps == [robot["late"] - 1] * robot["joints"]  # one is healthy
    for joint in calibration.joints:
        assert joint.delay.value / calibration.step == pytest.approx(robot["late"], abs=0.5)
        lag = joint.lag.value / calibration.step
        assert (1 - np.exp(-1 / lag) if lag else 1.0) == pytest.approx(robot["gain"], abs=0.05)
        assert joint.offset.value == pytest.approx(robot["offset"], abs=0.2)
        assert joint.delay.determined and joint.lag.determined and joint.offset.determined


def test_the_command_says_it_in_frames(tmp_path, monkeypatch, called):
    frozen = write(tmp_path / "pick_cube", gain=0.25, late=4, offset=-0.98, joints=1, seed=0)
    monkeypatch.chdir(tmp_path)
    said = called(command.main, "afm-rl-diagnose", "pick_cube", "--no-page").out
    assert f"left out: {', '.join(map(str, frozen))}" in said
    head, _, row = (line.strip() for line in said[said.index(" joint ") :].splitlines()[:3])
    names = ["joint", "delay (frames)", "gain per frame", "offset"]
    assert [part.strip() for part in head.split("  ") if part] == names
    name, *numbers = [part.strip().split(" [")[0] for part in row.split("  ") if part]
    assert name == "joint_0.pos"
    assert [float(number) for number in numbers] == pytest.approx([4, 0.25, -0.98], abs=0.1)
