"""Numbers by which methods are compared: their means, against an oracle, and in pairs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from afm_rl.report.cells import outcome, with_cells
from afm_rl.report.statistics import estimate, interquartile_mean, probability_of_improvement
from afm_rl.storage.measures import Measures


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
    missions = with_cells(missions)
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


def summarise(
    missions: pd.DataFrame, measures: Measures, by: Sequence[str] = ("method",)
) -> pd.DataFrame:
    """Return one row per method, in the order in which they first occur.

    Columns: those of ``by``; ``missions`` and ``cells``, how many; the mean of each measure under
    the name of its column, with ``_low`` and ``_high``; ``finished`` or ``terminated``, a share;
    ``faults`` and ``seconds``, in all, if they are known. The bounds are 95 % intervals of the
    stratified bootstrap, seeds drawn anew within cells; they are NaN where no cell has two
    missions, or where all are alike. Missions without a value (NaN) are left out of its mean.

    Args:
        missions: one row per mission.
        measures: what methods are compared by.
        by: columns that say which missions belong together, such as ``("cell", "method")``.

    >>> from afm_rl.storage.measures import Measure
    >>> share = Measures((Measure("share", "share", "share"),))
    >>> missions = pd.DataFrame({"method": "a", "track": "oval", "seed": [0, 1], "share": [0, 1.0]})
    >>> summarise(missions.assign(finished=True), share)[["method", "share"]].values.tolist()
    [['a', 0.5]]
    """
    rows, ended = [], outcome(missions)
    for key, group in count_budgets(missions, measures).groupby(list(by), sort=False):
        row = dict(zip(by, key, strict=True)) | {"missions": len(group)}
        row["cells"] = group["cell"].nunique()
        for measure in measures:
            row |= estimate(measure.column, group[measure.column], group["cell"])
        row[ended] = float(group[ended].mean())
        for name in ("faults", "seconds"):
            if name in group:
                row[name] = float(group[name].sum())
        rows.append(row)
    return pd.DataFrame(rows)


def pair(missions: pd.DataFrame, method: str, other: str) -> pd.DataFrame:
    """Return the missions that two methods share: same cell, same seed.

    Returns:
        One row per pair: ``cell``, ``seed``, and the columns of both, the other method's with
        the ending ``_other``.
    """
    mine, its = (missions[missions["method"] == name] for name in (method, other))
    return mine.merge(its, on=["cell", "seed"], suffixes=("", "_other"))


def aggregate(missions: pd.DataFrame, measures: Measures, oracle: str) -> pd.DataFrame:
    """Return :func:`summarise` with more columns.

    Interquartile means of each measure (``COLUMN_iqm``); if there is a budget, the geometric mean
    of what was spent over what the oracle spent, where it finished (``ratio``) and over all pairs
    (``ratio_all``), each with ``_low``, ``_high`` and ``_pairs``; ``per_hour``, missions per hour
    of computing, of those whose time was counted.

    Args:
        missions: one row per mission, with ``cell``, from :func:`count_budgets`.
        measures: what methods are compared by.
        oracle: name of the method that others are compared with.
    """
    rows = summarise(missions, measures).to_dict("records")
    for row in rows:
        own = missions[missions["method"] == row["method"]]
        for measure in measures:
            name = f"{measure.column}_iqm"
            row |= estimate(name, own[measure.column], own["cell"], interquartile_mean)
        if measures.budget and oracle in set(missions["method"]):
            pairs = pair(missions, row["method"], oracle)
            finished = pairs[pairs["finished_other"].astype(bool)]
            for name, chosen in (("ratio", finished), ("ratio_all", pairs)):
                # Counted from 0: one more has been spent, and no logarithm is of nothing.
                spent = chosen[measures.budget.column] + 1
                logs = np.log(spent / (chosen[f"{measures.budget.column}_other"] + 1))
                found = estimate(name, logs, chosen["cell"])
                row |= {key: float(np.exp(value)) for key, value in found.items()}
                row[f"{name}_pairs"] = len(chosen)
        counted, seconds = own.get("seconds", pd.Series()).count(), row.pop("seconds", 0.0)
        row["per_hour"] = 3600 * counted / seconds if seconds else math.nan
    return pd.DataFrame(rows)


def rank_missions(missions: pd.DataFrame, measures: Measures) -> pd.DataFrame:
    """Return the missions with ``rank``, whole numbers that order all of them.

    The headline measures decide: the first one, then, among equals, the next.

    >>> from afm_rl.storage.measures import Measure
    >>> share, steps = Measure("share", "", ""), Measure("steps", "", "", better="lower")
    >>> missions = pd.DataFrame({"share": [1.0, 1.0, 0.5], "steps": [90, 80, 99]})
    >>> rank_missions(missions, Measures((share,)))["rank"].tolist()
    [1, 1, 0]
    """
    signed = {f"_{each.column}": each.sign * missions[each.column] for each in measures.headlines}
    rank = missions.assign(**signed).groupby(list(signed), dropna=False).ngroup()
    return missions.assign(rank=rank)


def compare(missions: pd.DataFrame, measures: Measures, baselines: Sequence[str]) -> pd.DataFrame:
    """Return one row per baseline and other method that share a cell.

    Columns: ``baseline``, ``method``, ``pairs``; means of paired differences of each measure under
    its column's name (NaN without pairs), and ``better``, the probability of improvement, each
    with ``_low`` and ``_high``.

    Args:
        missions: from :func:`count_budgets`.
        measures: what methods are compared by.
        baselines: names of methods; those that have no missions are passed over.
    """
    rows = []
    groups = dict(iter(rank_missions(missions, measures).groupby("method", sort=False)))
    for baseline in (name for name in baselines if name in groups):
        for method, group in groups.items():
            other = groups[baseline]
            if method == baseline or not set(group["cell"]) & set(other["cell"]):
                continue
            pairs = pair(missions, str(method), baseline)
            row = {"baseline": baseline, "method": method, "pairs": len(pairs)}
            for column in (measure.column for measure in measures):
                apart = pairs[column] - pairs[f"{column}_other"]
                row |= estimate(column, apart, pairs["cell"])
            row["better"], ends = probability_of_improvement(group, other)
            row["better_low"], row["better_high"] = ends
            rows.append(row)
    return pd.DataFrame(rows)
