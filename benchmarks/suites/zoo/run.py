"""Policies that others trained, on robots whose actuators fail: alone, corrected, given the truth.

    python benchmarks/suites/zoo/run.py

plays what is not yet in `outputs/zoo`, prints the tables and draws the figure. It can be ended at
any time; the same command continues. `--policies`, `--faults`, `--methods` and `--episodes` choose
what is played and shown.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd
import torch
from episodes import complete
from faults import LATER, RARE
from methods import METHODS
from show import draw, ordered, print_tables, shares
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
    names = args.policies or sorted(file.stem for file in args.folder.glob("*.safetensors"))
    for name in names:
        task = Task(args.folder / f"{name}.safetensors")
        usual = [fault for fault in task.faults if fault not in RARE]
        faults = [fault for fault in args.faults or usual if fault in task.faults]
        task.at = task.at if args.at is None else args.at
        for method in args.methods:
            # one delay is told to all that are side by side
            for part in [[fault] for fault in faults] if method == "AFM, told" else [faults]:
                complete(task, method, part, args.episodes, args.out, args.steps)
    results = read(args.out)
    chosen_rows = results["policy"].isin(names) & (results["episode"] < args.episodes)
    for column, chosen in (("method", args.methods), ("fault", args.faults)):
        chosen_rows &= results[column].isin(chosen) if chosen else True
    results = results[chosen_rows]
    if {"alone", "none"} <= set(results["method"]) | set(results["fault"]):
        results = shares(ordered(results, list(METHODS), every))
        print_tables(results)
        draw(results, args.out / "zoo.png")


def read(out: Path) -> pd.DataFrame:
    """Return all results of a folder."""
    return pd.concat([pd.read_csv(file) for file in sorted(out.glob("*.csv"))], ignore_index=True)


if __name__ == "__main__":
    main()
