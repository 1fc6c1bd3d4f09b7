"""Episodes whose actuators fail, side by side, and how soon their rewards are as before."""

from __future__ import annotations

import time
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from methods import METHODS
from radio import Radio
from task import Task

from afm_rl import FaultVectorWrapper
from afm_rl.errors import ConfigurationError
from afm_rl.storage.files import write_whole

HEALTHY = [("none", episode) for episode in range(5)]  # what "as before" means is read from these
WINDOW, MISSING = 2.0, 0.1  # s; share of the healthy reward
LASTS = 0.25  # share of the rest of an episode for which a recovery lasts at least


def complete(
    task: Task,
    method: str,
    faults: list[str],
    episodes: int,
    out: Path,
    steps: int | None = None,
    together: int = 100,
) -> pd.DataFrame:
    """Play those episodes of a policy and a method that have no results yet; return all.

    Args:
        task: the policy and its task.
        method: who acts.
        faults: what happens.
        episodes: of each fault.
        out: folder of results.
        steps: of an episode; None for as many as the task has.
        together: episodes that are played side by side, and then kept.
    """
    file = out / f"{task.name}.{method.replace(', ', '_').replace(' ', '_')}.csv"
    rows = pd.read_csv(file).to_dict("records") if file.is_file() else []
    done = {(row["fault"], row["episode"]) for row in rows}
    wanted = [(fault, episode) for fault in faults for episode in range(episodes)]
    missing = [pair for pair in wanted if pair not in done]
    for first in range(0, len(missing), together):
        start, pairs = time.perf_counter(), missing[first : first + together]
        rows += play(task, method, pairs, min(steps or task.steps, task.steps))
        write_whole(file, pd.DataFrame(rows).to_csv(index=False).encode())
        spent = time.perf_counter() - start
        print(f"{task.name}, {method}: {len(pairs)} episodes in {spent:.0f} s", flush=True)
    return pd.DataFrame(rows)


def play(task: Task, method: str, pairs: list[tuple[str, int]], steps: int) -> list[dict]:
    """Play faults and episodes side by side; return a row of results for each."""
    if steps <= task.at:
        raise ConfigurationError(
            f"--steps {steps}: expected more than {task.at}, at which the actuators fail"
        )
    rewards, lasted = rewards_of(task, method, pairs, steps)
    window = min(round(WINDOW / task.twin.unwrapped.dt), steps - task.at)
    level = usual(healthy(task, steps)[task.at :], window)
    return [
        {
            "policy": task.name,
            "fault": fault,
            "method": method,
            "episode": episode,
            "before": mine[: task.at].sum(),
            "after": mine[task.at :].sum(),
            "survived": bool(last == steps),
            "lasted": int(last),
            "recovered": recovered(mine[task.at :], level, window),
        }
        for (fault, episode), mine, last in zip(pairs, rewards.T, lasted, strict=True)
    ]


def rewards_of(
    task: Task, method: str, pairs: list[tuple[str, int]], steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return rewards ``(T, N)``, 0 after the end of an episode, and how long each one lasted."""
    torch.manual_seed(0)
    faults = [task.faults[fault] for fault, _ in pairs]
    radio = Radio(task.vector(len(pairs)), [fault == "WiFi" for fault, _ in pairs])
    inner = FaultVectorWrapper(radio, faults, task.at, task.home, False)
    envs, act = METHODS[method](task, inner)
    task.begin(len(pairs))
    observations, infos = envs.reset(seed=[episode for _, episode in pairs])
    rewards, alive = np.zeros((steps, len(pairs))), np.ones(len(pairs), dtype=bool)
    lasted = np.zeros(len(pairs), dtype=int)
    for step in range(steps):
        observations, reward, terminated, truncated, infos = envs.step(act(observations, infos))
        rewards[step] = np.where(alive, reward, 0.0)
        lasted += alive
        alive &= ~(terminated | truncated)
        if not alive.any():
            break
    envs.close()
    return rewards, lasted


@cache
def healthy(task: Task, steps: int) -> np.ndarray:
    """Return the rewards ``(T, 5)`` of a policy that nothing happens to."""
    return rewards_of(task, "alone", HEALTHY, steps)[0]


def usual(rewards: np.ndarray, window: int) -> float:
    """Return the reward a step that healthy runs ``(T, N)`` never miss by more than a tenth.

    It is that of their worst window, less a tenth of their mean.

    >>> round(usual(np.ones((50, 2)), window=10), 6)
    0.9
    """
    worst = min(means(mine, window).min() for mine in rewards.T)
    return float(worst - MISSING * abs(rewards.mean()))


def recovered(rewards: np.ndarray, level: float, window: int) -> float:
    """Return after how many steps no window of the rewards ``(T,)`` has a mean below ``level``.

    Infinity where that lasts for less than a quarter of all windows.

    >>> recovered(np.r_[np.zeros(5), np.ones(20)], level=0.9, window=4)
    5.0
    """
    over = means(rewards, window)
    low = np.flatnonzero(over < level)
    start = 0 if not len(low) else int(low[-1]) + 1
    return float(start) if len(over) - start >= LASTS * len(over) else np.inf


def means(values: np.ndarray, window: int) -> np.ndarray:
    """Return the means of all windows of values ``(T,)``."""
    return np.convolve(values, np.full(window, 1 / window), "valid")
