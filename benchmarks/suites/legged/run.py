"""Legged robots that others trained, whose position servos fail: alone, corrected, with the truth.

    python benchmarks/suites/legged/run.py --folder FOLDER --robots go1 g1

plays what is not yet in `outputs/legged` and prints the tables. It can be ended at any time; the
same command goes on. The folder has NAME.xml and NAME_policy.onnx, see `docs/legged.md`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import pandas as pd
import torch

sys.path[:0] = [str(Path(__file__).parents[1] / name) for name in ("zoo", "legged")]
from episodes import complete  # noqa: E402
from methods import METHODS  # noqa: E402
from robot import OWN, Robot  # noqa: E402
from show import ordered, print_table  # noqa: E402

from afm_rl.regimes import servo_faults  # noqa: E402


def main() -> None:
    usual = ["alone", "least squares", "AFM", "truth"]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=OWN, help="where robots and policies are")
    parser.add_argument("--robots", nargs="*", help="default: all of the folder")
    parser.add_argument("--faults", nargs="*", choices=servo_faults(2), default=[*servo_faults(2)])
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=usual)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, help="cut episodes (use another --out)")
    parser.add_argument("--together", type=int, default=5, help="episodes between two savings")
    parser.add_argument("--out", type=Path, default=Path("outputs/legged"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    files = sorted(args.folder.glob("*_policy.onnx"))
    for name in args.robots or [file.stem.removesuffix("_policy") for file in files]:
        robot, rows = Robot(args.folder, name), []
        for method in args.methods:
            more = args.steps, args.together
            rows.append(complete(robot, method, args.faults, args.seeds, args.out, *more))
        results = pd.concat(rows, ignore_index=True)
        chosen = results["fault"].isin(args.faults) & (results["episode"] < args.seeds)
        results = with_errors(results[chosen], robot.at)
        print(f"\n{name}: mean error of the speed after the fault, m/s (survivors)\n")
        print_table(ordered(results, list(METHODS), args.faults), _cell)


def with_errors(results: pd.DataFrame, at: int) -> pd.DataFrame:
    """Return results with the mean ``error`` a step, from the fault to the end or the fall."""
    after = (results["lasted"] - at).clip(lower=1)
    return results.assign(error=-results["after"] / after)


def _cell(rows: pd.DataFrame) -> str:
    alive = rows["survived"]
    said = f"{rows['error'][alive].mean():.3f}" if alive.any() else "falls"
    return said if alive.all() else f"{said} ({alive.sum()} of {len(alive)})"


if __name__ == "__main__":
    main()
