"""Each method against a baseline, mission by mission."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from afm_rl.report.bootstrap import stratified_interval
from afm_rl.report.improvement import probability_of_improvement
from afm_rl.report.outcomes import pair
from afm_rl.report.table import Table, number

NOTE = (
    "Differences are means over missions of the same cell and seed (n pairs): positive success "
    "and negative steps speak for the method. P(better) is the probability that a mission of the "
    "method does better than one of the baseline in the same cell, all seeds against all "
    "(Agarwal et al. 2021): higher success first; between equals fewer steps, where a mission "
    "that was given up counts as its budget; a tie counts half. Brackets are 95 % intervals, seeds "
    "drawn anew within cells; there is none where no draw changes the number. Bold where 0, or a "
    "probability of 1/2, lies outside the interval."
)
MEASURES = {"success": "success_rate", "steps": "cost"}


def compare(missions: pd.DataFrame, baselines: Sequence[str]) -> pd.DataFrame:
    """Return one row per baseline and other method that share a cell.

    Columns: ``baseline``, ``method``, ``pairs``; ``success`` and ``steps``, means of paired
    differences (NaN without pairs), and ``better``, the probability of improvement, each with
    ``_low`` and ``_high``.

    Args:
        missions: from :func:`~afm_rl.report.outcomes.add_outcomes`.
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
            for name, column in MEASURES.items():
                apart = (pairs[column] - pairs[f"{column}_other"]).astype(float)
                low, high = stratified_interval(apart, pairs["cell"])
                row |= {name: apart.mean(), f"{name}_low": low, f"{name}_high": high}
            better, (low, high) = probability_of_improvement(group, other)
            row |= {"better": better, "better_low": low, "better_high": high}
            rows.append(row)
    return pd.DataFrame(rows)


def comparison_tables(numbers: pd.DataFrame) -> list[Table]:
    """Return :func:`compare` as one table per baseline."""
    if numbers.empty:
        return []
    return [
        _table(str(baseline), rows.reset_index(drop=True))
        for baseline, rows in numbers.groupby("baseline", sort=False)
    ]


def _table(baseline: str, numbers: pd.DataFrame) -> Table:
    shown, bold = [], set()
    for place, row in enumerate(numbers.to_dict("records")):
        shown.append(
            {
                "method": row["method"],
                "n pairs": str(row["pairs"]),
                "success, percentage points": _signed(row, "success", 100, 1),
                "steps": _signed(row, "steps", 1, 0),
                "P(better)": _signed(row, "better", 1, 2).replace("+", ""),
            }
        )
        for column, (name, null) in enumerate({"success": 0, "steps": 0, "better": 0.5}.items(), 2):
            if row[f"{name}_low"] > null or row[f"{name}_high"] < null:
                bold.add((place, column))
    title = f"Differences from {baseline}"
    name = f"against_{baseline}"
    return Table(name, title, NOTE, numbers, pd.DataFrame(shown), frozenset(bold))


def _signed(row: dict, name: str, scale: float, digits: int) -> str:
    """Return a number and its interval, each with its sign.

    >>> row = {"success": 0.1, "success_low": -0.05, "success_high": 0.2}
    >>> _signed(row, "success", 100, 0)
    '+10 [-5, +20]'
    """
    middle, low, high = (
        number(value, digits) if value != value else f"{scale * value:+.{digits}f}"
        for value in (row[name], row[f"{name}_low"], row[f"{name}_high"])
    )
    return middle if low == "-" else f"{middle} [{low}, {high}]"
