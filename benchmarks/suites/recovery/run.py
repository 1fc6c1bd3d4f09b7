"""Seconds from a fault of the actuators until a robot does as well as a healthy one: ten tasks.

    python benchmarks/suites/recovery/run.py

plays what is not yet in `outputs/recovery` and prints the table of docs/recovery.md. It can be
ended at any time; the same command goes on. `--tasks` and `--methods` choose.

Recovered: from then on, and for a quarter of the time at least, no two seconds are worse than the
worst two of healthy runs by more than a tenth of their mean. What counts is the reward, the speed
along the track, or less the error.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import torch

SUITES = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(SUITES / name) for name in ("zoo", "furuta", "recovery")]

from episodes import WINDOW, recovered, rewards_of, usual  # noqa: E402
from missions import MISSIONS  # noqa: E402
from missions import rewards as of_missions  # noqa: E402
from pendulums import rewards as of_pendulums  # noqa: E402
from task import POLICIES, Task  # noqa: E402

from afm_rl.storage.files import write_whole  # noqa: E402

FAULTS = ["one reversed", "all reversed", "half", "bias .3", "late 2", "swapped pair"]
METHODS = ["alone", "AFM", "truth"]
ZOO = {"hopper_trpo": 1000, "half_cheetah_tqc": 600, "walker2d_tqc": 1000, "ant_trpo": 600}
ZOO |= {"swimmer_trpo": 600}  # steps of an episode, 200 of them healthy
TASKS = [*ZOO, *MISSIONS, "Furuta"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=TASKS)
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=METHODS)
    parser.add_argument("--faults", nargs="*", choices=FAULTS, default=FAULTS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, help="cut episodes (use another --out)")
    parser.add_argument("--out", type=Path, default=Path("outputs/recovery"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    tables = []
    for task in args.tasks:
        level = None  # of what the robot has alone and healthy
        for method in dict.fromkeys(["alone", *args.methods]):
            file = args.out / f"{task.replace(' ', '_')}.{method}.csv"
            if not file.is_file():
                rows = pd.DataFrame(times(task, method, level, args))
                args.out.mkdir(parents=True, exist_ok=True)
                write_whole(file, rows.to_csv(index=False).encode())
                print(f"{task}, {method}: done", flush=True)
            tables.append(pd.read_csv(file))
            level = level or tables[-1]["level"][0]
    print_table(pd.concat(tables, ignore_index=True), args)


def times(task: str, method: str, level: float | None, args: argparse.Namespace) -> list[dict]:
    """Return the seconds until recovered of each fault and seed; by a level, if it is known."""
    pairs = [(fault, seed) for fault in ["none", *args.faults] for seed in range(args.seeds)]
    rewards, dt = rewards_after(task, method, pairs, args)
    window = max(1, round(WINDOW / dt))
    if level is None:
        healthy = [rewards["none", seed] for seed in range(args.seeds)]
        level = usual(np.stack([mine[: min(map(len, healthy))] for mine in healthy], 1), window)
    return [
        {
            "task": task,
            "method": method,
            "fault": fault,
            "seed": seed,
            "level": level,
            "seconds": dt * recovered(mine, level, window),
        }
        for (fault, seed), mine in rewards.items()
    ]


def rewards_after(
    task: str, method: str, pairs: list[tuple[str, int]], args: argparse.Namespace
) -> tuple[dict[tuple[str, int], np.ndarray], float]:
    """Return the rewards ``(T,)`` after the fault by fault and seed, and seconds a step."""
    if task in MISSIONS:
        return of_missions(task, method, args.faults, args.seeds, args.out, args.steps)
    if task == "Furuta":
        return of_pendulums(method, pairs, args.steps)
    zoo = Task(POLICIES / f"{task}.safetensors")
    pairs = [pair for pair in pairs if pair[0] in zoo.faults]
    found = rewards_of(zoo, method, pairs, args.steps or ZOO[task])[0][zoo.at :]
    return dict(zip(pairs, found.T, strict=True)), zoo.twin.unwrapped.dt


def print_table(rows: pd.DataFrame, args: argparse.Namespace) -> None:
    """Print the median over seeds of each task and fault, by method."""
    print(f"\nSeconds until recovered: {', '.join(args.methods)}; ∞: not within the episode\n")
    print(f"| | {' | '.join(args.faults)} |\n|---{'|---' * len(args.faults)}|")
    keys = ["task", "fault", "method"]
    middle = rows.groupby(keys)["seconds"].quantile(0.5, interpolation="higher")
    for task in args.tasks:
        cells = []
        for fault in args.faults:
            found = [middle.get((task, fault, method), np.nan) for method in args.methods]
            cells.append("–" if np.isnan(found).all() else ", ".join(map(_seconds, found)))
        print(f"| {task.replace('_', ' ')} | {' | '.join(cells)} |")


def _seconds(value: float) -> str:
    return "∞" if np.isinf(value) else f"{value:.1f}"


if __name__ == "__main__":
    main()
