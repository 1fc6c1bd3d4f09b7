"""Print the table of `docs/policies.md` from what `afm-rl` wrote for several policies of a task.

    python examples/policies/tables.py outputs/policies/reacher* --measure return

One line per change, one column per method and kind of training. Means over policies and episodes,
with 95 % intervals that draw policies and episodes anew; all policies fly the same episodes, so
that those drawn are the same for all (pigeonhole bootstrap, Owen 2007, arXiv 0712.1111).

`--measure recovered`: medians of the steps from the change until the mean reward of 20 steps is
for good at most a tenth below that of the same policy alone, in the same episode and steps, while
nothing changes; a tenth of the size of that policy's mean reward in the episode. ∞: never.
`--measure recovery_steps`: medians of what `afm-rl` writes, to the first 20 steps that reach the
reward before the change less a tenth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from numpy.lib.stride_tricks import sliding_window_view

DRAWS, WINDOW, MISSING = 4000, 20, 0.1
MEDIANS = ("recovered", "recovery_steps")
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
                about = {"policy": policy, "randomised": "randomised" in policy, "in": file.parent}
                tables.append(pd.read_csv(missions).assign(**about))
    return pd.concat(tables).drop_duplicates(["policy", "method", "regime", "seed"], keep="last")


def add_recovered(missions: pd.DataFrame) -> pd.DataFrame:
    """Return the missions in which something changes, with the steps until they recovered."""
    flown = {where: pd.read_parquet(where / "steps.parquet") for where in missions["in"].unique()}
    flown = {where: dict(list(steps.groupby("mission"))) for where, steps in flown.items()}
    alone = missions[(missions["method"] == "physics") & (missions["regime"] == "nominal")]
    healthy = {
        (row["policy"], row["seed"]): flown[row["in"]][row["mission"]]["reward"].to_numpy()
        for _, row in alone.iterrows()
    }
    changed = missions[missions["regime"] != "nominal"]
    found = [
        recovered(flown[row["in"]][row["mission"]], healthy[row["policy"], row["seed"]])
        for _, row in changed.iterrows()
    ]
    return changed.assign(recovered=found)


def recovered(steps: pd.DataFrame, healthy: np.ndarray) -> float:
    """Return the steps from the change until the rewards stay near those of a healthy episode."""
    change = int(np.flatnonzero(np.diff(steps["regime_active"]))[0]) + 1
    missing = sliding_window_view(healthy - steps["reward"].to_numpy(), WINDOW)[change:].mean(-1)
    bad = np.flatnonzero(missing > MISSING * abs(healthy.mean()))
    start = int(bad[-1]) + 1 if len(bad) else 0
    return float(start) if start < len(missing) else np.inf


def middle(values: np.ndarray, measure: str) -> np.ndarray:
    """Return means over the last two axes, medians of what may be infinite."""
    if measure not in MEDIANS:
        return values.mean((-2, -1))
    return np.quantile(values.reshape(*values.shape[:-2], -1), 0.5, axis=-1, method="lower")


def cell(rows: pd.DataFrame, measure: str, digits: int) -> str:
    """Return the mean and its interval; ``rows`` are those of one change and column."""
    if rows[measure].isna().all():
        return "–"
    values = rows.pivot(index="policy", columns="seed", values=measure).dropna(axis=1).to_numpy()
    rng, (policies, episodes) = np.random.default_rng(0), values.shape
    drawn = values[
        rng.integers(policies, size=(DRAWS, policies, 1)),
        rng.integers(episodes, size=(DRAWS, 1, episodes)),
    ]
    ends = np.quantile(middle(drawn, measure), [0.025, 0.975], method="nearest")
    mean, low, high = (
        f"{value:.{digits}f}".replace("inf", "∞") for value in (middle(values, measure), *ends)
    )
    return f"{mean} [{low}, {high}]"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", help="results of afm-rl")
    parser.add_argument("--measure", default="return", help="return, after, recovered, ...")
    parser.add_argument("--digits", type=int, default=1)
    args = parser.parse_args()
    missions = read(args.folders)
    if args.measure == "recovery_steps":
        missions = missions.fillna({"recovery_steps": np.inf})
    if args.measure == "recovered":
        missions = add_recovered(missions)
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
