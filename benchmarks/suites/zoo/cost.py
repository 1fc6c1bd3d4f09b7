"""Processor time of a step of each correction, as a multiple of the time of AFM.

    python benchmarks/suites/zoo/cost.py --policy half_cheetah_tqc

One environment for each method, stepped in turns in one process, from a fault on. The time
without AFM is subtracted.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from methods import method_of
from task import POLICIES, Task

from afm_rl import FaultVectorWrapper
from afm_rl.comparison.episodes import corrected
from afm_rl.report.tables import markdown

DEFAULT = ["without AFM", "least squares", "L1", "AFM"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="half_cheetah_tqc")
    parser.add_argument("--folder", type=Path, default=POLICIES, help="where the policy is")
    parser.add_argument("--fault", default="one reversed")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--methods", nargs="*", default=DEFAULT)
    args = parser.parse_args()
    torch.set_num_threads(1)
    task = Task(args.folder / f"{args.policy}.safetensors")
    spent = {name: np.quantile(times, 0.5) for name, times in measure(task, args).items()}
    added = {name: seconds - spent["without AFM"] for name, seconds in spent.items()}
    rows = [(name, f"{1e6 * x:.0f}", f"{x / added['AFM']:.2f}") for name, x in added.items()]
    print(markdown("cost", pd.DataFrame(rows, columns=["method", "µs a step", "of AFM's"])))


def measure(task: Task, args: argparse.Namespace) -> dict[str, list[float]]:
    """Return the seconds of processor time of every step, of each method."""
    fault = task.faults[args.fault]
    players, spent = {}, {name: [] for name in args.methods}
    for name in args.methods:
        robot, method = method_of(name, task, args.fault)
        inner = FaultVectorWrapper(robot.vector(1), fault)
        envs, act = corrected(robot, inner, task.begin([0]), method)
        players[name] = [envs, act, envs.reset(seed=[0])[0]]
    for _ in range(args.steps):
        for name, player in players.items():
            envs, act, seen = player
            start = time.process_time()
            player[2] = envs.step(act(seen, {}))[0]
            spent[name].append(time.process_time() - start)
    return spent


if __name__ == "__main__":
    main()
