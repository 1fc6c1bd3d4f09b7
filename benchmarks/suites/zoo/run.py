"""Policies that others trained, on robots whose actuators fail: without AFM, corrected, oracle.

    python benchmarks/suites/zoo/run.py

plays the episodes that are not yet in `outputs/zoo`, prints the tables and draws the figure. You
can interrupt it; the same command continues. `--policies`, `--faults`, `--methods` and `--episodes`
select what is played and shown.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
import torch
from episodes import complete
from faults import LATER, RARE
from methods import METHODS
from show import draw, ordered, print_each, print_tables, shares
from task import POLICIES, Task

from afm_rl.regimes import presets


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", nargs="*", help="names of files; default: all")
    every = [*presets(2), *LATER]
    parser.add_argument("--faults", nargs="*", choices=every, help="default: all but rare ones")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=list(METHODS))
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--at", type=int, help="step of the faults (use another --out)")
    parser.add_argument("--steps", type=int, help="cut episodes (use another --out)")
    parser.add_argument("--folder", type=Path, default=POLICIES, help="where the policies are")
    parser.add_argument("--out", type=Path, default=Path("outputs/zoo"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    names, parts = args.policies or sorted(x.stem for x in args.folder.glob("*.safetensors")), []
    for name in names:
        task = Task(args.folder / f"{name}.safetensors")
        usual_faults = [fault for fault in task.faults if fault not in RARE]
        faults = [fault for fault in args.faults or usual_faults if fault in task.faults]
        task.at = task.at if args.at is None else args.at
        for method in args.methods:
            rows = complete(task, method, faults, args.episodes, args.out, args.steps)
            parts.append(rows[rows["fault"].isin(faults) & (rows["seed"] < args.episodes)])
    results = ordered(pd.concat(parts, ignore_index=True), METHODS, every)
    print_each(results)
    if {"without AFM", "none"} <= set(results["method"]) | set(results["fault"]):
        results = shares(results)
        print_tables(results)
        draw(results, args.out / "zoo.png")


if __name__ == "__main__":
    main()
