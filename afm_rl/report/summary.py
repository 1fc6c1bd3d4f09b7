"""One row per method: means, with their intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from afm_rl.report.frames import cell_names, outcome
from afm_rl.report.statistics import stratified_interval
from afm_rl.storage.measures import Measures


def summarise(missions: pd.DataFrame, measures: Measures) -> pd.DataFrame:
    """Return one row per method, in the order in which they first occur.

    Columns: ``method``; ``missions`` and ``cells``, how many; the mean of each measure under the
    name of its column, with ``_low`` and ``_high``; ``finished`` or ``terminated``, a share;
    ``faults`` and ``seconds``, in all, if they are known. The bounds are 95 % intervals of the
    stratified bootstrap, seeds drawn anew within cells; they are NaN where no cell has two
    missions, or where all are alike. Missions without a value (NaN) are left out of its mean.

    Args:
        missions: one row per mission.
        measures: what methods are compared by.

    >>> from afm_rl.storage.measures import Measure
    >>> share = Measures((Measure("share", "share", "share"),))
    >>> missions = pd.DataFrame({"method": "a", "track": "oval", "seed": [0, 1], "share": [0, 1.0]})
    >>> summarise(missions.assign(finished=True), share)[["method", "share"]].values.tolist()
    [['a', 0.5]]
    """
    return _means(missions, measures, ["method"])


def summarise_cells(missions: pd.DataFrame, measures: Measures) -> pd.DataFrame:
    """Return one row per cell (track and regime) and method, like :func:`summarise`."""
    return _means(missions, measures, ["cell", "method"])


def _means(missions: pd.DataFrame, measures: Measures, by: Sequence[str]) -> pd.DataFrame:
    named = count_budgets(missions, measures)
    rows, ended = [], outcome(missions)
    for key, group in named.groupby(list(by), sort=False):
        row = dict(zip(by, key, strict=True)) | {"missions": len(group)}
        row["cells"] = group["cell"].nunique()
        for measure in measures:
            known = group[group[measure.column].notna()]
            row[measure.column] = float(known[measure.column].astype(float).mean())
            ends = stratified_interval(known[measure.column], known["cell"])
            row |= {
                f"{measure.column}_{end}": x for end, x in zip(("low", "high"), ends, strict=True)
            }
        row[ended] = float(group[ended].mean())
        for name in ("faults", "seconds"):
            if name in group:
                row[name] = float(group[name].sum())
        rows.append(row)
    return pd.DataFrame(rows)


def count_budgets(missions: pd.DataFrame, measures: Measures) -> pd.DataFrame:
    """Return the missions with ``cell``; those that did not finish count as the cell's budget.

    That is the most that any unfinished mission of the cell spent: without it a method with a
    smaller budget would look as if it needed less.

    >>> from afm_rl.storage.measures import Measure
    >>> steps = Measures((Measure("steps", "steps", "steps", better="lower", budget=True),))
    >>> rows = {"cell": ["a"] * 3, "steps": [90, 60, 99], "finished": [True, False, False]}
    >>> count_budgets(pd.DataFrame(rows), steps)["steps"].tolist()
    [90, 99, 99]
    """
    if "cell" not in missions:
        missions = missions.assign(cell=cell_names(missions))
    if measures.budget is None:
        return missions
    column, finished = missions[measures.budget.column], missions["finished"].astype(bool)
    most = column.where(~finished).groupby(missions["cell"]).transform("max")
    counted = np.where(finished, column, most).astype(column.dtype)
    return missions.assign(**{measures.budget.column: counted})


def budget_notes(missions: pd.DataFrame, measures: Measures) -> list[str]:
    """Say what a mission that did not finish counts as, and where budgets differ."""
    spent = measures.budget
    if spent is None or (given_up := missions[~missions["finished"].astype(bool)]).empty:
        return []
    ends = given_up.groupby("cell", sort=False)[spent.column].agg(["min", "max"])
    apart = [
        f"{cell}: missions were given up after {row['min']} to {row['max']} {spent.name}; all of "
        f"them count as {row['max']}."
        for cell, row in ends[ends["min"] < ends["max"]].iterrows()
    ]
    budgets = " or ".join(f"{most} {spent.name}" for most in sorted(set(ends["max"])))
    return [
        f"{len(given_up)} of {len(missions)} missions did not finish within their budget and count "
        f"as {budgets} (counted from 0). Such numbers do not compare with those of results under "
        "another budget.",
        *apart,
    ]
