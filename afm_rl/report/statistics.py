"""Numbers by which methods are compared, with intervals of the stratified bootstrap."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from afm_rl.report.runs import outcome, with_scenarios
from afm_rl.storage.measures import Measures


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half (Agarwal et al. 2021).

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 99.0])))
    1.5
    """
    from scipy.stats import trim_mean  # slow to import, and not needed for a mission alone

    return trim_mean(values, 0.25, axis=axis)


def estimate(
    name: str,
    values: pd.Series,
    strata: pd.Series,
    statistic: Callable[..., np.ndarray] = np.mean,
) -> dict[str, float]:
    """Return a statistic and its 95 % percentile bootstrap interval, resampled within strata.

    The draws are the same at each call. Where no draw changes the statistic, as with one mission
    per stratum, the interval is NaN at both ends. Missing values are left out.

    Args:
        name: of the entries that are returned.
        values: the sample, ``(N,)``.
        strata: the scenario of each, ``(N,)``.
        statistic: takes ``(R, N)`` and ``axis``, returns ``(R,)``.

    >>> estimate("a", pd.Series([1.0, 3.0, math.nan]), pd.Series(["x", "y", "y"]))
    {'a': 2.0, 'a_low': nan, 'a_high': nan}
    """
    present = values.notna()
    sample = values[present].to_numpy(dtype=float)
    bounds = resampled_bounds(
        split(sample, strata[present]),
        lambda samples: statistic(np.concatenate(samples, -1), axis=-1),
    )
    middle = float(statistic(sample)) if len(sample) else math.nan
    return {name: middle, f"{name}_low": float(bounds[0]), f"{name}_high": float(bounds[1])}


def split(values: np.ndarray, strata: ArrayLike) -> list[np.ndarray]:
    """Return the rows ``(N, ...)`` of each stratum."""
    groups = pd.Series(np.asarray(strata)).groupby(np.asarray(strata)).indices
    return [values[rows] for rows in groups.values()]


def resampled_bounds(
    samples: Sequence[np.ndarray],
    statistic: Callable[[list[np.ndarray]], np.ndarray],
    resamples: int = 2000,
    room: int = 4_000_000,
) -> np.ndarray:
    """Return the 95 % percentile interval of a statistic of several samples, each drawn again.

    Args:
        samples: ``(N_k, ...)`` each.
        statistic: takes the samples with the rows last, ``(..., R, N_k)`` each, and returns
            ``(..., R)``.
        resamples: how many draws.
        room: numbers that are in memory at a time.

    Returns:
        Lower and upper bound, ``(2, ...)``; NaN where no draw changes the statistic.
    """
    drawn = [k for k, sample in enumerate(samples) if len(sample) > 1]  # others cannot vary
    if not drawn:
        return np.full((2, *(samples[0].shape[1:] if len(samples) else ())), math.nan)

    def with_the_rest(*parts: np.ndarray, axis: int) -> np.ndarray:
        lead = parts[0].shape[:-1]
        rows_last = [np.moveaxis(sample, 0, -1)[..., None, :] for sample in samples]
        every = [np.broadcast_to(rows, (*lead, rows.shape[-1])) for rows in rows_last]
        for k, part in zip(drawn, parts, strict=True):
            every[k] = part
        return statistic(every)

    from scipy.stats import bootstrap  # slow to import, and not needed for a mission alone

    size = sum(sample.size for sample in samples)
    result = bootstrap(
        [samples[k] for k in drawn],
        with_the_rest,
        n_resamples=resamples,
        batch=max(1, min(resamples, room // max(size, 1))),
        vectorized=True,
        axis=0,
        confidence_level=0.95,
        method="percentile",
        rng=0,
    )
    draws = result.bootstrap_distribution
    alike = np.ptp(draws, -1) < 1e-12 * np.maximum(1.0, np.abs(draws).max(-1))
    return np.where(alike, math.nan, np.stack(result.confidence_interval))


def count_budgets(missions: pd.DataFrame, measures: Measures) -> pd.DataFrame:
    """Return the missions with ``scenario``; unfinished ones count as the budget of theirs.

    That is the most that any unfinished mission of the scenario spent: without it a method with a
    smaller budget would look as if it needed less.

    >>> from afm_rl.storage.measures import Measure
    >>> steps = Measures((Measure("steps", "steps", "steps", better="lower", budget=True),))
    >>> rows = {"scenario": ["a"] * 3, "steps": [90, 60, 99], "finished": [True, False, False]}
    >>> count_budgets(pd.DataFrame(rows), steps)["steps"].tolist()
    [90, 99, 99]
    """
    missions = with_scenarios(missions)
    if measures.budget is None:
        return missions
    column, finished = missions[measures.budget.column], missions["finished"].astype(bool)
    budget = column.where(~finished).groupby(missions["scenario"]).transform("max")
    counted = np.where(finished, column, budget).astype(column.dtype)
    return missions.assign(**{measures.budget.column: counted})


def budget_notes(missions: pd.DataFrame, measures: Measures) -> list[str]:
    """Say what a mission that did not finish counts as."""
    spent = measures.budget
    if spent is None or (given_up := missions[~missions["finished"].astype(bool)]).empty:
        return []
    budgets = given_up.groupby("scenario")[spent.column].max().unique()
    counted = " or ".join(f"{budget} {spent.name}" for budget in sorted(budgets))
    return [
        f"{len(given_up)} of {len(missions)} missions did not finish within their budget and count "
        f"as {counted}, the largest budget of their scenario. Do not compare such numbers with "
        "results under another budget."
    ]


def summarise(
    missions: pd.DataFrame, measures: Measures, by: Sequence[str] = ("method",)
) -> pd.DataFrame:
    """Return one row per method, in order of first occurrence.

    Columns: those of ``by``; the numbers of ``missions`` and ``scenarios``; the mean of each
    measure under the name of its column, with ``_low`` and ``_high``; ``finished`` or
    ``terminated``, a share; the sums of ``faults`` and ``seconds``, if known. The bounds are 95 %
    intervals of the stratified bootstrap, seeds drawn again within scenarios; they are NaN if no
    scenario has two missions, or if all are equal. Missions without a value (NaN) are excluded from
    its mean.

    Args:
        missions: one row per mission.
        measures: measures for the comparison.
        by: columns that group the missions, such as ``("scenario", "method")``.

    >>> from afm_rl.storage.measures import Measure
    >>> share = Measures((Measure("share", "share", "share"),))
    >>> missions = pd.DataFrame({"method": "a", "track": "oval", "seed": [0, 1], "share": [0, 1.0]})
    >>> summarise(missions.assign(finished=True), share)[["method", "share"]].values.tolist()
    [['a', 0.5]]
    """
    rows, ended = [], outcome(missions)
    for key, group in count_budgets(missions, measures).groupby(list(by), sort=False):
        row = dict(zip(by, key, strict=True)) | {"missions": len(group)}
        row["scenarios"] = group["scenario"].nunique()
        for measure in measures:
            row |= estimate(measure.column, group[measure.column], group["scenario"])
        row[ended] = float(group[ended].mean())
        for name in ("faults", "seconds"):
            if name in group:
                row[name] = float(group[name].sum())
        rows.append(row)
    return pd.DataFrame(rows)


def pair(missions: pd.DataFrame, method: str, other: str) -> pd.DataFrame:
    """Return the missions that two methods share: same scenario, same seed.

    Returns:
        One row per pair: ``scenario``, ``seed``, and the columns of both, the other method's with
        the ending ``_other``.
    """
    mine, its = (missions[missions["method"] == name] for name in (method, other))
    return mine.merge(its, on=["scenario", "seed"], suffixes=("", "_other"))


def aggregate(missions: pd.DataFrame, measures: Measures) -> pd.DataFrame:
    """Return :func:`summarise` with the interquartile mean of each measure, ``COLUMN_iqm``."""
    rows = summarise(missions, measures).to_dict("records")
    for row in rows:
        group = missions[missions["method"] == row["method"]]
        for column in (measure.column for measure in measures):
            values, strata = group[column], group["scenario"]
            row |= estimate(f"{column}_iqm", values, strata, interquartile_mean)
    return pd.DataFrame(rows)


def compare(missions: pd.DataFrame, measures: Measures, baselines: Sequence[str]) -> pd.DataFrame:
    """Return one row per baseline and other method that share a mission's scenario and seed.

    Columns: ``baseline``, ``method``, ``pairs``; means of paired differences of each measure under
    its column's name, with ``_low`` and ``_high``.
    """
    rows, methods = [], missions["method"].unique()
    for baseline in (name for name in baselines if name in methods):
        for method in methods[methods != baseline]:
            pairs = pair(missions, method, baseline)
            if pairs.empty:
                continue
            row = {"baseline": baseline, "method": method, "pairs": len(pairs)}
            for column in (measure.column for measure in measures):
                apart = pairs[column] - pairs[f"{column}_other"]
                row |= estimate(column, apart, pairs["scenario"])
            rows.append(row)
    return pd.DataFrame(rows)
