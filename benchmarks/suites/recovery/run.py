"""Seconds from a fault of the actuators until a robot does as well as a healthy one: ten tasks.

    python benchmarks/suites/recovery/run.py

plays what is not yet in `outputs/recovery` and prints the table. It can be
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

from episodes import WINDOW, complete, recovered, usual  # noqa: E402
from missions import MISSIONS  # noqa: E402
from missions import rewards as of_missions  # noqa: E402
from pendulums import rewards as of_pendulums  # noqa: E402
from task import POLICIES, Task  # noqa: E402

from afm_rl.report.tables import markdown  # noqa: E402
from afm_rl.storage.files import write_whole  # noqa: E402

FAULTS = ["one reversed", "all reversed", "half", "bias .3", "late 2", "swapped pair"]
METHODS = ["alone", "AFM", "truth"]
ZOO = ["hopper_trpo", "half_cheetah_tqc", "walker2d_tqc", "ant_trpo", "swimmer_trpo"]
TASKS = [*ZOO, *MISSIONS, "Furuta"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=TASKS)
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=METHODS)
    parser.add_argument("--faults", nargs="*", choices=FAULTS, default=FAULTS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, help="cut episodes (use another --out)")
    parser.add_argument("--out", type=Path, default=Path("outputs/recovery"))
    parser.add_argument("--zoo", type=Path, default=Path("outputs/zoo"), help="results of policies")
    args = parser.parse_args()
    torch.set_num_threads(1)
    tables = []
    for task in args.tasks:
        level = None  # of what the robot has alone and healthy
        for method in dict.fromkeys(["alone", *args.methods]):
            file = args.out / f"{task.replace(' ', '_')}.{method}.csv"
            if not file.is_file():
                rows = pd.DataFrame(times(task, method, level, args))
                write_whole(file, rows.to_csv(index=False).encode())
                print(f"{task}, {method}: done", flush=True)
            tables.append(pd.read_csv(file))
            level = tables[-1]["level"][0] if level is None else level
    print(markdown("seconds until recovered", table(pd.concat(tables, ignore_index=True), args)))


def times(task: str, method: str, level: float | None, args: argparse.Namespace) -> list[dict]:
    """Return the seconds until recovered of each fault and seed; by a level, if it is known."""
    pairs = [(fault, seed) for fault in ["none", *args.faults] for seed in range(args.seeds)]
    if task in ZOO:
        return times_of_policy(task, method, pairs, args)
    if task == "Furuta":
        rewards, dt = of_pendulums(method, pairs, args.steps)
    else:
        rewards, dt = of_missions(task, method, args.faults, args.seeds, args.out, args.steps)
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


def times_of_policy(
    name: str, method: str, pairs: list[tuple[str, int]], args: argparse.Namespace
) -> list[dict]:
    """Return the same for a policy, from the results of the zoo, which are completed."""
    task = Task(POLICIES / f"{name}.safetensors")
    faults = [fault for fault in dict.fromkeys(fault for fault, _ in pairs) if fault in task.faults]
    rows = complete(task, method, faults, args.seeds, args.zoo, args.steps)
    rows = rows[[pair in set(pairs) for pair in zip(rows["fault"], rows["episode"], strict=True)]]
    rows = rows.assign(seconds=rows["recovered"] * task.twin.unwrapped.dt, level=None, task=name)
    rows = rows.rename(columns={"episode": "seed"})
    return rows[["task", "method", "fault", "seed", "level", "seconds"]].to_dict("records")


def table(rows: pd.DataFrame, args: argparse.Namespace) -> pd.DataFrame:
    """Return the median over seeds of each task and fault, by method."""
    middle = rows.groupby(["task", "fault", "method"])["seconds"]
    middle = middle.quantile(0.5, interpolation="higher")
    cells = {"": [task.replace("_", " ") for task in args.tasks]}
    for fault in args.faults:
        medians = [
            [middle.get((task, fault, m), np.nan) for m in args.methods] for task in args.tasks
        ]
        cells[fault] = [
            "–" if np.isnan(some).all() else ", ".join(map(_seconds, some)) for some in medians
        ]
    return pd.DataFrame(cells)


def _seconds(value: float) -> str:
    return "∞" if np.isinf(value) else f"{value:.1f}"


if __name__ == "__main__":
    main()
