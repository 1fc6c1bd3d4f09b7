"""Policies that others trained, on robots whose actuators fail: alone, corrected, given the truth.

    python benchmarks/suites/zoo/run.py

plays what is not yet in `outputs/zoo`, prints the tables and draws the figure. It can be ended at
any time; the same command goes on. `--policies`, `--faults`, `--methods` and `--episodes` choose.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from faults import FaultyVector, faults_of
from methods import METHODS
from show import draw, ordered, print_tables, shares
from task import Task

from afm_rl.storage.files import write_whole

POLICIES = Path(__file__).parents[3] / "examples" / "policies" / "zoo"
WINDOW, MISSING = 100, 0.1  # recovered: no 100 steps lose more than a tenth of the healthy reward


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", nargs="*", help="names of files; default: all")
    parser.add_argument("--faults", nargs="*", help="default: all")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--steps", type=int, help="cut episodes (use another --out)")
    parser.add_argument("--side-by-side", type=int, default=64, help="episodes in one batch")
    parser.add_argument("--folder", type=Path, default=POLICIES, help="where the policies are")
    parser.add_argument("--out", type=Path, default=Path("outputs/zoo"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    for name in args.policies or sorted(file.stem for file in args.folder.glob("*.safetensors")):
        task = Task(args.folder / f"{name}.safetensors")
        faults = [fault for fault in args.faults or task.faults if fault in task.faults]
        for method in args.methods:
            complete(task, method, faults, args)
    results = read(args.out)
    if {"alone", "none"} <= set(results["method"]) | set(results["fault"]):
        results = shares(ordered(results, list(METHODS), list(faults_of(2))))
        print_tables(results)
        draw(results, args.out / "zoo.png")


def read(out: Path) -> pd.DataFrame:
    """Return all results of a folder."""
    return pd.concat([pd.read_csv(file) for file in sorted(out.glob("*.csv"))], ignore_index=True)


def complete(task: Task, method: str, faults: list[str], args: argparse.Namespace) -> None:
    """Play those episodes of a policy and a method that have no results yet."""
    file = args.out / f"{task.name}.{method.replace(', ', '_').replace(' ', '_')}.csv"
    rows = pd.read_csv(file).to_dict("records") if file.is_file() else []
    done = {(row["fault"], row["episode"]) for row in rows}
    wanted = [(fault, episode) for fault in faults for episode in range(args.episodes)]
    missing = [pair for pair in wanted if pair not in done]
    for first in range(0, len(missing), args.side_by_side):
        start, pairs = time.perf_counter(), missing[first : first + args.side_by_side]
        rows += play(task, method, pairs, args.steps or task.steps)
        args.out.mkdir(parents=True, exist_ok=True)
        write_whole(file, pd.DataFrame(rows).to_csv(index=False).encode())
        spent = time.perf_counter() - start
        print(f"{task.name}, {method}: {len(pairs)} episodes in {spent:.0f} s", flush=True)


def play(task: Task, method: str, pairs: list[tuple[str, int]], steps: int) -> list[dict]:
    """Play faults and episodes side by side; return a row of results for each."""
    torch.manual_seed(0)
    rows = torch.stack([task.regime.encode(task.faults[fault]) for fault, _ in pairs])
    inner = FaultyVector(task.vector(len(pairs)), task.regime, rows, task.at)
    envs, act = METHODS[method](task, inner)
    observations, _ = envs.reset(seed=[episode for _, episode in pairs])
    rewards, alive = np.zeros((steps, len(pairs))), np.ones(len(pairs), dtype=bool)
    lasted = np.zeros(len(pairs), dtype=int)
    for step in range(steps):
        observations, reward, terminated, truncated, _ = envs.step(act(observations))
        rewards[step] = np.where(alive, reward, 0.0)
        lasted += alive
        alive &= ~(terminated | truncated)
        if not alive.any():
            break
    envs.close()
    return [
        {
            "policy": task.name,
            "fault": fault,
            "method": method,
            "episode": episode,
            "before": mine[: task.at].sum(),
            "after": mine[task.at :].sum(),
            "survived": bool(last == steps),
            "recovered": recovered(mine, task.at),
        }
        for (fault, episode), mine, last in zip(pairs, rewards.T, lasted, strict=True)
    ]


def recovered(rewards: np.ndarray, at: int) -> float:
    """Return how many steps after ``at`` the rewards ``(T,)`` are again what they were before.

    From there on no mean of WINDOW steps is below that before the change by more than a tenth.
    """
    window = min(WINDOW, at)
    means = np.convolve(rewards, np.full(window, 1 / window), "valid")
    usual = rewards[at - window : at].mean()
    low = np.flatnonzero(means[at:] < usual - MISSING * abs(usual))
    start = 0 if not len(low) else int(low[-1]) + 1
    return float(start) if start < len(means[at:]) else np.inf


if __name__ == "__main__":
    main()
