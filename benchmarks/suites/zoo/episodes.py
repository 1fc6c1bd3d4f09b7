"""Episodes of a policy, stored as soon as they are played."""

from __future__ import annotations

import time
from functools import cache
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd
from methods import method_of
from radio import WiFi
from task import Task

from afm_rl.comparison.episodes import play, rows_of, usual, window_of
from afm_rl.errors import ConfigurationError
from afm_rl.storage.files import write_whole

HEALTHY = 5  # episodes that define the return of the healthy robot


def complete(
    task: Task, method: str, faults: list[str], episodes: int, out: Path, steps: int | None = None
) -> pd.DataFrame:
    """Play the episodes of a policy and a method that have no results yet; return all results.

    Args:
        task: the policy and its task.
        method: one of :data:`methods.METHODS`.
        faults: names of faults of the task.
        episodes: of each fault.
        out: folder of results.
        steps: of an episode; None for the number of the task.
    """
    steps = min(steps or task.steps, task.steps)
    if steps <= task.at:
        raise ConfigurationError(
            f"--steps {steps}: expected more than {task.at}, at which the actuators fail"
        )
    file = out / f"{task.name}.{method.replace(', ', '_').replace(' ', '_')}.csv"
    rows = pd.read_csv(file).to_dict("records") if file.is_file() else []
    done = {(row["fault"], row["seed"]) for row in rows}
    cases = [(fault, seed) for fault in faults for seed in range(episodes)]
    missing = [case for case in cases if case not in done]
    apart = set(faults) if method == "AFM, known delay" else {"WiFi"}  # each is a batch of its own
    for _, group in groupby(missing, lambda case: case[0] if case[0] in apart else None):
        start, batch = time.perf_counter(), list(group)
        for row in episodes_of(task, method, batch, steps):
            rows.append({"policy": task.name, "method": method, **row})
        write_whole(file, pd.DataFrame(rows).to_csv(index=False).encode())
        spent = time.perf_counter() - start
        print(f"{task.name}, {method}: {len(batch)} episodes in {spent:.0f} s", flush=True)
    return pd.DataFrame(rows)


def episodes_of(task: Task, method: str, cases: list[tuple[str, int]], steps: int) -> list[dict]:
    """Play faults and seeds side by side; return a row of results for each."""
    names, seeds = zip(*cases, strict=True)
    robot, acting = method_of(method, task, names[0])
    if "WiFi" in names:
        robot = WiFi(robot.name, robot.make, robot.settings, robot.home)
    faults = [task.faults[name] for name in names]
    played = play(robot, task.begin, acting, faults, seeds, task.at, steps)
    window = window_of(task.robot, steps - task.at)
    return rows_of(played, cases, task.at, usual(healthy(task, steps)[task.at :], window), window)


@cache
def healthy(task: Task, steps: int) -> np.ndarray:
    """Return the rewards ``(T, 5)`` of a policy on the healthy robot."""
    seeds = range(HEALTHY)
    return play(task.robot, task.begin, "none", [{}] * HEALTHY, seeds, steps, steps).rewards
