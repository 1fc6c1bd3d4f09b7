"""The tables by which methods are compared: all missions, against a baseline, cell by cell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from afm_rl.report.frames import outcome
from afm_rl.report.statistics import (
    interquartile_mean,
    probability_of_improvement,
    stratified_interval,
)
from afm_rl.report.summary import summarise, summarise_cells
from afm_rl.report.table import Table, best_places, interval_text, number
from afm_rl.storage.measures import Measure, Measures

BOOTSTRAP = (
    "Brackets are 95 % intervals of the stratified bootstrap (Agarwal et al. 2021): seeds are "
    "drawn anew within each cell; there is none where no cell has two missions or where all are "
    "alike. "
)
ALL_NOTE = (
    "IQM is the interquartile mean, the mean of the middle half of the missions. "
    + BOOTSTRAP
    + "{ratio}"
    "Methods with different numbers of missions were not given the same task: compare them by "
    "pairs. Bold: the best of those with the most missions, {oracle} apart."
)
RATIO_NOTE = (
    "A mission that did not finish counts with its budget. The ratio of {name} to those of "
    "{oracle} is a geometric mean over missions of the same cell and seed (n pairs), once where "
    "{oracle} finished and once over all. "
)
PAIRS_NOTE = (
    "Differences are means over missions of the same cell and seed (n pairs). P(better) is the "
    "probability that a mission of the method does better than one of the baseline in the same "
    "cell, all seeds against all (Agarwal et al. 2021): {order}; a tie counts half. "
    + BOOTSTRAP
    + "Bold "
    "where 0, or a probability of 1/2, lies outside the interval."
)
CELL_NOTE = "Means: {names}. Bold: the best of a cell."
RATIO = Measure("ratio", "ratio", "ratio")


def rank_missions(missions: pd.DataFrame, measures: Measures) -> pd.DataFrame:
    """Return the missions with ``rank``, whole numbers that order all of them.

    The headline measures decide: the first one, then, among equals, the next.

    >>> share, steps = Measure("share", "", ""), Measure("steps", "", "", better="lower")
    >>> missions = pd.DataFrame({"share": [1.0, 1.0, 0.5], "steps": [90, 80, 99]})
    >>> rank_missions(missions, Measures((share,)))["rank"].tolist()
    [1, 1, 0]
    """
    signed = {f"_{each.column}": each.sign * missions[each.column] for each in measures.headlines}
    rank = missions.assign(**signed).groupby(list(signed), dropna=False).ngroup()
    return missions.assign(rank=rank)


def pair(missions: pd.DataFrame, method: str, other: str) -> pd.DataFrame:
    """Return the missions that two methods share: same cell, same seed.

    Returns:
        One row per pair: ``cell``, ``seed``, and the columns of both, the other method's with
        the ending ``_other``.
    """
    mine, its = (missions[missions["method"] == name] for name in (method, other))
    return mine.merge(its, on=["cell", "seed"], suffixes=("", "_other"))


def aggregate(
    missions: pd.DataFrame, measures: Measures, compute: pd.DataFrame, oracle: str
) -> pd.DataFrame:
    """Return :func:`~afm_rl.report.summary.summarise` with more columns.

    Interquartile means of each measure (``COLUMN_iqm``); if there is a budget, the geometric mean
    of what was spent over what the oracle spent, where it finished (``ratio``) and over all pairs
    (``ratio_all``), each with ``_low``, ``_high`` and ``_pairs``; ``per_hour``, missions per hour
    of computing.

    Args:
        missions: one row per mission, with ``cell``, from
            :func:`~afm_rl.report.summary.count_budgets`.
        measures: what methods are compared by.
        compute: seconds and missions by method, where runs counted them.
        oracle: name of the method that others are compared with.
    """
    rows = summarise(missions, measures).to_dict("records")
    for row in rows:
        own = missions[missions["method"] == row["method"]]
        for measure in measures:
            known = own[own[measure.column].notna()]
            values, name = known[measure.column].to_numpy(dtype=float), f"{measure.column}_iqm"
            row[name] = float(interquartile_mean(values)) if len(values) else math.nan
            ends = stratified_interval(values, known["cell"], interquartile_mean)
            row[f"{name}_low"], row[f"{name}_high"] = ends
        if measures.budget and oracle in set(missions["method"]):
            pairs = pair(missions, row["method"], oracle)
            finished = pairs[pairs["finished_other"].astype(bool)]
            row |= _ratio(finished, "ratio", measures.budget)
            row |= _ratio(pairs, "ratio_all", measures.budget)
        row["per_hour"] = _per_hour(row, compute)
    return pd.DataFrame(rows)


def _ratio(pairs: pd.DataFrame, name: str, spent: Measure) -> dict[str, float]:
    """Return the geometric mean of what was spent, with its interval and the number of pairs."""
    # Counted from 0: one more has been spent, and no logarithm is of nothing.
    logs = np.log((pairs[spent.column] + 1) / (pairs[f"{spent.column}_other"] + 1))
    low, high = np.exp(stratified_interval(logs, pairs["cell"]))
    mean = float(np.exp(logs.mean())) if len(logs) else math.nan
    return {name: mean, f"{name}_low": low, f"{name}_high": high, f"{name}_pairs": len(logs)}


def _per_hour(row: dict, compute: pd.DataFrame) -> float:
    seconds, count = row.get("seconds", math.nan), row["missions"]
    if row["method"] in compute.index:
        seconds, count = compute.loc[row["method"], ["seconds", "missions"]]
    return float(3600 * count / seconds) if seconds > 0 else math.nan


def summary_table(means: pd.DataFrame, measures: Measures, oracle: str = "") -> Table:
    """Return :func:`aggregate`, or as much of it as there is, as a table.

    The best of all complete methods is bold, but for the oracle: it knows what no other method
    knows and does not compete, and neither does a method that was spared some cells.
    """
    rows, signs, ended = [], {}, outcome(means)
    for row in means.to_dict("records"):
        shown = {"method": row["method"], "missions": str(row["missions"])}
        shown[f"{ended} (%)"] = number(100 * row[ended])
        signs[ended] = 1 if ended == "finished" else -1
        for measure in measures:
            for end, word in (("", ""), ("_iqm", ", IQM")):
                if (name := f"{measure.column}{end}") in means:
                    signs[name] = measure.sign
                    shown[measure.head + word] = interval_text(measure, row, name, measure.digits)
        if (spent := measures.budget) and "ratio" in means:
            for name, words in (("ratio", "where it finished"), ("ratio_all", "all")):
                text, count = interval_text(RATIO, row, name, 2), row[f"{name}_pairs"]
                shown[f"{spent.name} / {oracle}, {words}"] = f"{text} (n = {count})"
                signs[name] = -1
        if "faults" in means and means["faults"].any():
            shown["faults"] = number(row["faults"])
        for name, word in (("per_hour", "missions per hour"), ("seconds", "seconds")):
            if name in means:
                shown[word] = number(row[name], int(name == "seconds"))
        rows.append(shown)
    complete = means["missions"] == means["missions"].max()
    rivals = means.where(complete & (means["method"] != oracle))
    rivals = rivals.assign(**{name: rivals[name].astype(float) for name in signs})
    ratio = RATIO_NOTE.format(name=measures.budget.name, oracle=oracle) if measures.budget else ""
    note = ALL_NOTE.format(ratio=ratio, oracle=oracle)
    title = "All missions of each method"
    return Table("aggregate", title, note, means, pd.DataFrame(rows), best_places(rivals, signs))


def compare(missions: pd.DataFrame, measures: Measures, baselines: Sequence[str]) -> pd.DataFrame:
    """Return one row per baseline and other method that share a cell.

    Columns: ``baseline``, ``method``, ``pairs``; means of paired differences of each measure under
    its column's name (NaN without pairs), and ``better``, the probability of improvement, each
    with ``_low`` and ``_high``.

    Args:
        missions: from :func:`rank_missions`, with ``cell``.
        measures: what methods are compared by.
        baselines: names of methods; those that have no missions are passed over.
    """
    rows = []
    groups = dict(iter(missions.groupby("method", sort=False)))
    for baseline in (name for name in baselines if name in groups):
        for method, group in groups.items():
            other = groups[baseline]
            if method == baseline or not set(group["cell"]) & set(other["cell"]):
                continue
            pairs = pair(missions, str(method), baseline)
            row = {"baseline": baseline, "method": method, "pairs": len(pairs)}
            for column in (measure.column for measure in measures):
                apart = (pairs[column] - pairs[f"{column}_other"]).astype(float)
                known = apart.notna()
                row[column] = apart.mean()
                ends = stratified_interval(apart[known], pairs["cell"][known])
                row[f"{column}_low"], row[f"{column}_high"] = ends
            row["better"], ends = probability_of_improvement(group, other)
            row["better_low"], row["better_high"] = ends
            rows.append(row)
    return pd.DataFrame(rows)


def comparison_tables(numbers: pd.DataFrame, measures: Measures) -> list[Table]:
    """Return :func:`compare` as one table per baseline."""
    if numbers.empty:
        return []
    return [
        _against(str(baseline), rows.reset_index(drop=True), measures)
        for baseline, rows in numbers.groupby("baseline", sort=False)
    ]


def _against(baseline: str, numbers: pd.DataFrame, measures: Measures) -> Table:
    shown, bold = [], set()
    nulls = {measure.column: 0.0 for measure in measures} | {"better": 0.5}
    for place, row in enumerate(numbers.to_dict("records")):
        texts = {"method": row["method"], "n pairs": str(row["pairs"])}
        texts |= {measure.head: _signed(measure, row) for measure in measures}
        texts["P(better)"] = interval_text(RATIO, row, "better", 2)
        shown.append(texts)
        for column, (name, null) in enumerate(nulls.items(), 2):
            if row[f"{name}_low"] > null or row[f"{name}_high"] < null:
                bold.add((place, column))
    order = ", then among equals ".join(f"{m.better} {m.name} first" for m in measures.headlines)
    note = PAIRS_NOTE.format(order=order)
    title = f"Differences from {baseline}"
    name = f"against_{baseline}"
    return Table(name, title, note, numbers, pd.DataFrame(shown), frozenset(bold))


def _signed(measure: Measure, row: dict) -> str:
    """Return a difference and its interval, each with its sign.

    >>> row = {"share": 0.1, "share_low": -0.05, "share_high": 0.2}
    >>> _signed(Measure("share", "share", "share", "%", scale=100), row)
    '+10 [-5, +20]'
    """
    middle, low, high = (
        f"+{text}" if row[key] >= 0 else text
        for key in (measure.column, f"{measure.column}_low", f"{measure.column}_high")
        for text in [measure.text(row[key])]
    )
    return middle if low == "-" else f"{middle} [{low}, {high}]"


def cell_table(missions: pd.DataFrame, measures: Measures) -> Table:
    """Return the means of each method (a column) in each cell (a row), by the headline measures."""
    numbers, methods = summarise_cells(missions, measures), list(missions["method"].unique())
    rows, bold, short = [], set(), measures.headlines
    for place, (cell, group) in enumerate(numbers.groupby("cell", sort=False)):
        texts, rank = {"cell": cell} | dict.fromkeys(methods, "-"), {}
        for row in group.to_dict("records"):
            # Many numbers side by side: whole percentages are enough.
            parts = [m.text(row[m.column], 0 if m.scale > 1 else m.digits) for m in short]
            texts[row["method"]] = " / ".join(parts)
            rank[row["method"]] = tuple(m.sign * row[m.column] for m in short)
        rows.append(texts)
        if len(set(rank.values())) > 1:
            best = max(rank.values())
            bold |= {(place, methods.index(name) + 1) for name in rank if rank[name] == best}
    note = CELL_NOTE.format(names=" / ".join(measure.head for measure in short))
    return Table("cells", "Cell by cell", note, numbers, pd.DataFrame(rows), frozenset(bold))
