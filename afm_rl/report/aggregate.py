"""One row per method: how it did in all."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from afm_rl.report.bootstrap import interquartile_mean, stratified_interval
from afm_rl.report.outcomes import pair
from afm_rl.report.table import Table, best_places, number, with_interval

NOTE = (
    "Success is the share of targets reached; steps of a mission that was given up count as its "
    "budget. IQM is the interquartile mean, the mean of the middle half of the missions. Brackets "
    "are 95 % intervals of the stratified bootstrap (Agarwal et al. 2021): seeds are drawn anew "
    "within each cell; there is none where no cell has two missions or where all are alike. The "
    "ratio of steps to those of {oracle} is a geometric mean over missions of the same cell and "
    "seed (n pairs), once where {oracle} finished and once over all. Methods with different "
    "numbers of missions were not given the same task: compare them by pairs. Bold: the "
    "best of those with the most missions, {oracle} apart."
)
MEANS = {"success": "success_rate", "steps": "cost"}
BETTER = {name: "max" for name in ("success", "success_iqm", "finished")} | {
    name: "min" for name in ("steps", "steps_iqm", "ratio", "ratio_all")
}


def aggregate(missions: pd.DataFrame, compute: pd.DataFrame, oracle: str) -> pd.DataFrame:
    """Return one row per method, in the order in which they first occur.

    Columns: ``method``, ``missions``, ``cells``; means ``success`` and ``steps`` and
    interquartile means ``success_iqm`` and ``steps_iqm``, each with ``_low`` and ``_high``;
    ``finished``, a share; ``ratio``, the geometric mean of steps over those of the oracle where
    it finished, with interval and ``ratio_pairs``; the same over all pairs as ``ratio_all``;
    ``per_hour``, missions per hour of computing.

    Args:
        missions: from :func:`~afm_rl.report.outcomes.add_outcomes`.
        compute: seconds and missions by method, where studies counted them.
        oracle: name of the method that steps are compared with.
    """
    rows = []
    for method, group in missions.groupby("method", sort=False):
        row: dict[str, object] = {"method": method, "missions": len(group)}
        row["cells"] = group["cell"].nunique()
        for name, column in MEANS.items():
            for ending, statistic in (("", np.mean), ("_iqm", interquartile_mean)):
                values = group[column].to_numpy(dtype=float)
                low, high = stratified_interval(values, group["cell"], statistic)
                row[name + ending] = float(statistic(values))
                row |= {f"{name}{ending}_low": low, f"{name}{ending}_high": high}
        row["finished"] = float(group["finished"].mean())
        pairs = pair(missions, str(method), oracle)
        row |= _ratio(pairs[pairs["finished_other"].astype(bool)], "ratio")
        row |= _ratio(pairs, "ratio_all")
        row["per_hour"] = _per_hour(str(method), group, compute)
        rows.append(row)
    return pd.DataFrame(rows)


def _ratio(pairs: pd.DataFrame, name: str) -> dict[str, float]:
    """Return the geometric mean of steps made, with its interval and the number of pairs."""
    # Steps are numbered from 0: one more has been made, and no logarithm is of nothing.
    logs = np.log((pairs["cost"] + 1) / (pairs["cost_other"] + 1)).to_numpy(dtype=float)
    low, high = np.exp(stratified_interval(logs, pairs["cell"]))
    mean = float(np.exp(logs.mean())) if len(logs) else math.nan
    return {name: mean, f"{name}_low": low, f"{name}_high": high, f"{name}_pairs": len(logs)}


def _per_hour(method: str, missions: pd.DataFrame, compute: pd.DataFrame) -> float:
    if method in compute.index:
        seconds, count = compute.loc[method, "seconds"], compute.loc[method, "missions"]
    elif "seconds" in missions:
        seconds, count = missions["seconds"].sum(), missions["seconds"].notna().sum()
    else:
        return math.nan
    return float(3600 * count / seconds) if seconds > 0 else math.nan


def aggregate_table(means: pd.DataFrame, oracle: str) -> Table:
    """Return :func:`aggregate` as a table; the best of all complete methods is bold."""
    rows = []
    for row in means.to_dict("records"):
        shown = {
            "method": row["method"],
            "missions": str(row["missions"]),
            "success %": _percent(row, "success"),
            "success % (IQM)": _percent(row, "success_iqm"),
            "finished %": number(100 * row["finished"]),
            "steps": _steps(row, "steps", 0),
            "steps (IQM)": _steps(row, "steps_iqm", 0),
            f"steps / {oracle}, where it finished": _pairs(row, "ratio"),
            f"steps / {oracle}, all": _pairs(row, "ratio_all"),
            "missions per hour": number(row["per_hour"]),
        }
        rows.append(shown)
    shown = pd.DataFrame(rows)
    places = dict(zip(BETTER, (2, 3, 4, 5, 6, 7, 8), strict=True))
    # The oracle knows what nobody else knows: it is no rival; nor is who was spared some cells.
    complete = means["missions"] == means["missions"].max()
    rivals = means.where(complete & (means["method"] != oracle))
    rivals = rivals.assign(**{name: rivals[name].astype(float) for name in BETTER})
    return Table(
        "aggregate",
        "All missions of each method",
        NOTE.format(oracle=oracle),
        means,
        shown,
        best_places(rivals, BETTER, places),
    )


def _percent(row: dict, name: str) -> str:
    value, low, high = (100 * row[key] for key in (name, f"{name}_low", f"{name}_high"))
    return with_interval(value, low, high, 1)


def _steps(row: dict, name: str, digits: int) -> str:
    return with_interval(row[name], row[f"{name}_low"], row[f"{name}_high"], digits)


def _pairs(row: dict, name: str) -> str:
    count = row[f"{name}_pairs"]
    return f"{_steps(row, name, 2)} (n = {count})" if count else "-"
