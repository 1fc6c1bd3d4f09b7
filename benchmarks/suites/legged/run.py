"""Policies of legged robots, trained by others, whose position servos fail.

    python benchmarks/suites/legged/run.py --folder FOLDER --robots go1 g1

plays the episodes that are not yet in `outputs/legged` and prints the tables; `--figure FILE` draws
them. You can interrupt it; the same command continues. The folder contains NAME.xml and
NAME_policy.onnx, see `README.md`.
"""

from __future__ import annotations

import argparse
import sys
from itertools import product
from pathlib import Path

import pandas as pd
import torch

sys.path[:0] = [str(Path(__file__).parents[1] / name) for name in ("zoo", "legged")]
from episodes import complete  # noqa: E402
from methods import METHODS  # noqa: E402
from robot import OWN, Robot  # noqa: E402
from show import ordered, table_by  # noqa: E402

from afm_rl.regimes import servo_faults  # noqa: E402
from afm_rl.report import style  # noqa: E402
from afm_rl.report.tables import markdown  # noqa: E402
from afm_rl.storage.files import write_whole  # noqa: E402


def main() -> None:
    usual = ["without AFM", "least squares", "AFM", "oracle"]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=OWN, help="where robots and policies are")
    parser.add_argument("--robots", nargs="*", help="default: all of the folder")
    parser.add_argument("--faults", nargs="*", choices=servo_faults(2), default=[*servo_faults(2)])
    parser.add_argument("--each", action="store_true", help="reverse one servo after the other")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=usual)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--at", type=int, nargs="*", help="steps of the fault; default: a fifth")
    parser.add_argument("--steps", type=int, help="cut episodes (use another --out)")
    parser.add_argument("--out", type=Path, default=Path("outputs/legged"))
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    tables: dict[str, pd.DataFrame] = {}
    files = sorted(args.folder.glob("*_policy.onnx"))
    for name in args.robots or [file.stem.removesuffix("_policy") for file in files]:
        robot, rows, faults = Robot(args.folder, name), [], args.faults
        if args.each:
            each = {f"{k} reversed": {f"gain_{k}": -1.0} for k in range(len(robot.low))}
            robot.faults, faults = robot.faults | each, [*each]
        for at, method in product(args.at or [robot.at], args.methods):
            robot.at, out = at, args.out / f"at_{at}" if args.at else args.out
            played = complete(robot, method, faults, args.seeds, out, args.steps)
            rows.append(with_errors(played, at))
        results = pd.concat(rows, ignore_index=True)
        chosen = results["fault"].isin(faults) & (results["seed"] < args.seeds)
        if args.each:
            results["fault"], faults = "each reversed", ["each reversed"]
        tables[name] = ordered(results[chosen], list(METHODS), faults)
        title = f"{name}, at {len(args.at)} steps" if args.at else name
        title += f", {len(robot.low)} servos" if args.each else ""
        print(markdown(title, table_by(tables[name], "method", _cell)))
    if args.figure:
        draw(tables, args.figure)


def with_errors(results: pd.DataFrame, at: int) -> pd.DataFrame:
    """Return results with the mean ``error`` a step, from the fault to the end or the fall."""
    after = (results["lasted"] - at).clip(lower=1)
    return results.assign(error=-results["after"] / after)


def draw(tables: dict[str, pd.DataFrame], file: Path) -> None:
    """Draw the errors: a panel per robot, a row per fault, a mark per method and episode."""
    faults = list(next(iter(tables.values()))["fault"].cat.categories)
    figure = style.new_figure(3.4 * len(tables) + 1.6, 0.36 * len(faults) + 1.3)
    shown = {method for results in tables.values() for method in results["method"].cat.categories}
    looks = style.method_styles([method for method in METHODS if method in shown])
    panels = figure.subplots(1, len(tables), sharey=True, squeeze=False)[0]
    for panel, (robot, results) in zip(panels, tables.items(), strict=True):
        most = 1.15 * results["error"][results["survived"]].max()
        panel.axvline(most, color=style.FAINT, lw=0.8)
        methods = results["method"].cat.categories
        for place, method in enumerate(methods):
            rows, look = results[results["method"] == method], looks[method]
            error = rows["error"].where(rows["survived"], 1.08 * most)
            at = rows["fault"].cat.codes + 0.16 * (place - (len(methods) - 1) / 2)
            panel.plot(error, at, look.marker, color=look.color, ms=5, mew=0, label=method)
        style.dress(panel, "error of the speed (m/s)", size=style.LARGE)
        panel.set_title(robot.capitalize(), fontsize=style.LARGE)
        panel.set(xlim=(0, 1.16 * most), ylim=(len(faults) - 0.5, -0.5))
        panel.set_xticks([tick for tick in panel.get_xticks() if 0 <= tick < most])
        panel.set_yticks(range(len(faults)), faults, fontsize=style.LARGE)
        panel.text(1.08 * most, -0.55, "falls", ha="center", va="bottom", fontsize=style.SMALL)
    style.legend_above(figure, *panels[0].get_legend_handles_labels())
    write_whole(file, style.png_bytes(figure))


def _cell(rows: pd.DataFrame) -> str:
    alive = rows["survived"]
    said = f"{rows['error'][alive].mean():.3f}" if alive.any() else "falls"
    return said if alive.all() else f"{said} ({alive.sum()} of {len(alive)})"


if __name__ == "__main__":
    main()
