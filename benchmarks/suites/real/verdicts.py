"""Simulated logs: their faults, and the diagnosis of each.

    python benchmarks/suites/real/verdicts.py
    python benchmarks/suites/real/verdicts.py --healthy 200

The first prints the table of the page *Real robots*; the second simulates healthy joints with
noise, rests, coarse sensors and end stops like those of real arms, and prints the joints that are
not called healthy.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np
import pandas as pd

from afm_rl.diagnosis import Actuator, Log, diagnose
from afm_rl.diagnosis.replay import replay
from afm_rl.report.tables import markdown


def steps(seed: int, rows: int, size: int, hold: int = 10, low: float = -1.0) -> np.ndarray:
    """Return commands from ``low`` to 1 that hold for some rows each, ``(rows, size)``."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(low, 1, (rows // hold + 1, size)), hold, axis=0)[:rows]


def servo(u: np.ndarray, rate: float = np.inf, late: int = 0, share: float = 1.0) -> np.ndarray:
    """Return positions that move a share of the way to commands, at most ``rate`` a row."""
    y = u.copy()
    for k in range(1, len(u)):
        y[k] = y[k - 1] + np.clip(share * (u[max(k - late, 0)] - y[k - 1]), -rate, rate)
    return y


def pulses(seed: int, rows: int, size: float) -> np.ndarray:
    """Return commands of 0 with pulses of five rows, ``(rows, 1)``."""
    rng, u, k = np.random.default_rng(seed), np.zeros((rows, 1)), 10
    while k < rows - 20:
        u[k : k + 5] = size * rng.uniform(-1, 1)
        k += 5 + int(rng.integers(5, 25))
    return u


def hover(seed: int, rows: int = 214, step: float = 0.104) -> Log:
    """Return speeds of a robot that hovers: set-points hardly move, and responses wander."""
    rng = np.random.default_rng(seed)
    u = 0.3 * np.cumsum(0.0007 * rng.standard_normal((rows, 2)), axis=0)
    drift = np.cumsum(rng.standard_normal((rows, 2)), axis=0)
    y = u + 0.011 * (drift / drift.std(0) + 0.3 * rng.standard_normal((rows, 2)))
    return Log(("vx", "vy"), u, y, t=step * np.arange(rows))


def log_of(u: np.ndarray, y: np.ndarray, noise: float, **how: tuple[str, str]) -> Log:
    """Return a log of joints with noise."""
    names = tuple(f"joint_{j}" for j in range(u.shape[1]))
    return Log(names, u, y + noise * np.random.default_rng(1).standard_normal(y.shape), **how)


def diagnosis_of(log: Log) -> str:
    """Return the text of a diagnosis; equal texts of several joints appear once."""
    found = diagnose(log)
    texts: dict[str, list[str]] = {}
    for actuator in found.actuators:
        texts.setdefault(actuator.sentence.partition(": ")[2], []).append(actuator.name)
    alike = len(texts) == 1
    parts = [text if alike else f"{', '.join(names)}: {text}" for text, names in texts.items()]
    return "; ".join([*found.common, *parts])


def table() -> Iterator[tuple[str, str, str]]:
    """Yield a description of a log, its simulated fault, and the diagnosis."""
    white = np.random.default_rng(0).uniform(-1, 1, (400, 6))
    yield "six joints, responses of 10 u", "10 times", diagnosis_of(log_of(white, 10 * white, 0.02))
    u, ticks = steps(0, 800, 6), 4096 / (2 * np.pi)
    gains = np.where(np.arange(6) == 2, 0.6, 1.0)
    log = log_of(u, ticks * gains * u, 3.0, units=("rad", "ticks"))
    yield "six joints in ticks, 4096 a turn", "652 ticks per rad; joint_2: 60 %", diagnosis_of(log)
    rests = np.repeat(np.random.default_rng(0).random((30, 1)) < 0.67, 20, axis=0)
    u = np.where(rests, 0.0, np.random.default_rng(1).uniform(-1, 1, (600, 1)))
    said = replay(log_of(u, 0.5 * u, 0.003)).sentence
    yield "a joint that rests two thirds of the time, gain .5, `--replay`", "98 %", said
    yield "speeds of a robot that hovers", "not identifiable", diagnosis_of(hover(0))
    u = 500 * steps(9, 300, 1) + 25 * steps(9, 300, 4)
    log = log_of(u, servo(u, 180.0, 2), 1.0)
    yield "four servos that are commanded alike", "180 a row, 2 rows late", diagnosis_of(log)
    u = pulses(0, 600, 900.0)
    yield (
        "a servo and pulses of five rows",
        "180 a row, 2 rows late",
        diagnosis_of(log_of(u, servo(u, 180.0, 2), 4.0)),
    )
    u = steps(0, 900, 1)
    yield "a position servo in a hurry", ".05 a row", diagnosis_of(log_of(u, servo(u, 0.05), 0.01))
    u = 100 * steps(0, 720, 1, 12, 0.0)
    yield (
        "a gripper of 0 to 100 that does 100 - u",
        "reversed",
        diagnosis_of(log_of(u, 100 - u, 0.4)),
    )


def healthy_arms(joints: int, size: int = 6, episodes: int = 12, seed: int = 0) -> Iterator[Log]:
    """Yield logs of healthy arms at 30 frames a second until they have so many joints.

    The followers of an arm share delay and lag. They rest at the start of an episode; sensors are
    noisy, some coarse; leaders or followers stop at the end of their range.
    """
    for first in range(0, joints, size):
        rng = np.random.default_rng((seed, first))
        share, late = rng.choice([0.25, 0.4, 0.7, 1.0]), int(rng.integers(1, 5))
        noise, quantum = rng.choice([0.03, 0.1, 0.3]), rng.choice([0.0, 0.088])
        leads, follows = rng.permutation([np.inf, rng.uniform(48, 58)])  # degrees
        count, window = min(size, joints - first), np.hanning(12) / np.hanning(12).sum()
        parts = []
        for episode in range(episodes):
            rows = int(rng.integers(90, 130))
            ways = np.repeat(rng.uniform(-60, 60, (rows // 12 + 2, count)), 12, axis=0)
            u = np.stack([np.convolve(way, window, "valid")[:rows] for way in ways.T], -1)
            u[: rows // 4] = u[rows // 4]
            u = u.clip(-leads, leads)
            y = servo(u.clip(-follows, follows), late=late, share=share)
            y += noise * rng.standard_normal(y.shape)
            if quantum:
                y = quantum * np.round(y / quantum)
            parts.append((u, y, np.full(rows, episode)))
        u, y, episode = (np.concatenate(part) for part in zip(*parts, strict=True))
        names = tuple(f"joint_{first + j}" for j in range(count))
        yield Log(names, u, y, t=np.arange(len(u)) / 30, episode=episode)


def accused(joints: int, **how: int) -> list[Actuator]:
    """Return the healthy joints that are not called healthy."""
    found = (diagnose(log).actuators for log in healthy_arms(joints, **how))
    return [actuator for arm in found for actuator in arm if actuator.status != "healthy"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--healthy", type=int, help="simulate this number of healthy joints instead"
    )
    args = parser.parse_args()
    if args.healthy is None:
        rows = pd.DataFrame(table(), columns=["log", "simulated fault", "diagnosis"])
        print(markdown("verdicts", rows))
        return
    wrong = accused(args.healthy)
    said = "; ".join(actuator.sentence for actuator in wrong)
    heads = ["healthy joints", "not called healthy", "diagnosis"]
    print(markdown("healthy", pd.DataFrame([[args.healthy, len(wrong), said]], columns=heads)))


if __name__ == "__main__":
    main()
