"""Print the table of `docs/policies.md` from what `afm-rl` wrote for several policies of a task.

    python examples/policies/tables.py outputs/policies/reacher* --measure return

One line per change, one column per method and kind of training. Means over policies and episodes,
with 95 % intervals that draw the policies anew, and of each the episodes (hierarchical bootstrap,
Davison and Hinkley 1997, section 3.8).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

DRAWS = 4000
COLUMNS = {
    "alone": ("physics", False),
    "randomised": ("physics", True),
    "least squares": ("adaptive_gain", False),
    "AFM": ("afm_physics", False),
    "randomised + AFM": ("afm_physics", True),
    "AFM, learned": ("afm_frozen_pe", False),
    "told": ("oracle", False),
}


def read(folders: list[Path]) -> pd.DataFrame:
    """Return one row per mission, with the policy that flew it and how it was trained."""
    tables = []
    for folder in folders:
        for file in sorted(folder.rglob("config.yaml")):
            if (missions := file.with_name("missions.csv")).is_file():
                policy = Path(yaml.safe_load(file.read_text())["planner"]["file"]).stem
                kind = {"policy": policy, "randomised": "randomised" in policy}
                tables.append(pd.read_csv(missions).assign(**kind))
    return pd.concat(tables).drop_duplicates(["policy", "method", "regime", "seed"], keep="last")


def interval(groups: list[np.ndarray]) -> tuple[float, float]:
    """Return the 95 % interval of the mean over groups of episodes, one group per policy."""
    rng = np.random.default_rng(0)
    means = np.stack([rng.choice(g, (DRAWS, len(g))).mean(1) for g in groups], 1)
    drawn = rng.integers(len(groups), size=(DRAWS, len(groups)))
    low, high = np.quantile(np.take_along_axis(means, drawn, 1).mean(1), [0.025, 0.975])
    return float(low), float(high)


def cell(rows: pd.DataFrame, measure: str, digits: int) -> str:
    groups = [group.dropna().to_numpy() for _, group in rows.groupby("policy")[measure]]
    groups = [group for group in groups if len(group)]
    if not groups:
        return "–"
    low, high = interval(groups)
    mean = np.mean([group.mean() for group in groups])
    return f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", help="results of afm-rl")
    parser.add_argument("--measure", default="return", help="return, before, after, ...")
    parser.add_argument("--digits", type=int, default=1)
    args = parser.parse_args()
    missions = read(args.folders)
    shown = {
        name: missions[(missions["method"] == method) & (missions["randomised"] == randomised)]
        for name, (method, randomised) in COLUMNS.items()
    }
    shown = {name: rows for name, rows in shown.items() if len(rows)}
    print(f"| change | {' | '.join(shown)} |\n|---{'|---' * len(shown)}|")
    for regime in missions["regime"].unique():
        cells = [
            cell(rows[rows["regime"] == regime], args.measure, args.digits)
            for rows in shown.values()
        ]
        print(f"| {regime} | {' | '.join(cells)} |")
    for name, rows in shown.items():
        print(f"{name}: {rows['policy'].nunique()} policies, {rows['seed'].nunique()} episodes")


if __name__ == "__main__":
    main()
