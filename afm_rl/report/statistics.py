"""Numbers by which methods are compared, with intervals of the stratified bootstrap."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from afm_rl.report.runs import outcome, with_scenarios
from afm_rl.storage.measures import Measures

Bounds = tuple[float, float]


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
    work: int = 1,
    room: int = 4_000_000,
) -> np.ndarray:
    """Return the 95 % percentile interval of a statistic of several samples, each drawn anew.

    Args:
        samples: ``(N_k, ...)`` each.
        statistic: takes the samples with the rows last, ``(..., R, N_k)`` each, and returns
            ``(..., R)``.
        resamples: how many draws.
        work: numbers that the statistic makes of one number.
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

    size = work * sum(sample.size for sample in samples)
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


def probability_of_improvement(mine: pd.DataFrame, other: pd.DataFrame) -> tuple[float, Bounds]:
    r"""Return :math:`P(X > Y)` with its 95 % interval (Agarwal et al. 2021).

    .. math:: \frac{1}{C} \sum_c \frac{1}{n_c m_c} \sum_{i, j}
              [x_{ci} > y_{cj}] + \tfrac{1}{2} [x_{ci} = y_{cj}]

    Within each scenario that both methods have, every mission of one meets every mission of the
    other, whatever their seeds; scenarios count alike. The interval draws the missions of both
    anew within scenarios. NaN if no scenario is shared.

    Args:
        mine: missions of one method, with ``scenario`` and ``rank``.
        other: those of the other one.

    >>> mine = pd.DataFrame({"scenario": ["a", "a"], "rank": [1, 3]})
    >>> probability_of_improvement(mine, pd.DataFrame({"scenario": ["a"], "rank": [1]}))[0]
    0.75
    """
    ranks = [frame.groupby("scenario")["rank"].agg(np.array) for frame in (mine, other)]
    scenarios = ranks[0].index.intersection(ranks[1].index)
    if scenarios.empty:
        return math.nan, (math.nan, math.nan)

    def share_won(samples: list[np.ndarray]) -> np.ndarray:
        pairs = zip(samples[: len(scenarios)], samples[len(scenarios) :], strict=True)
        won = [0.5 * (np.sign(x[..., None] - y[..., None, :]) + 1) for x, y in pairs]
        return np.mean([part.mean((-2, -1)) for part in won], axis=0)

    samples = [rank[scenario].astype(float) for rank in ranks for scenario in scenarios]
    low, high = resampled_bounds(samples, share_won, work=max(map(len, samples)))
    return float(share_won(samples)), (float(low), float(high))


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
    most = column.where(~finished).groupby(missions["scenario"]).transform("max")
    counted = np.where(finished, column, most).astype(column.dtype)
    return missions.assign(**{measures.budget.column: counted})


def budget_notes(missions: pd.DataFrame, measures: Measures) -> list[str]:
    """Say what a mission that did not finish counts as, and where budgets differ."""
    spent = measures.budget
    if spent is None or (given_up := missions[~missions["finished"].astype(bool)]).empty:
        return []
    ends = given_up.groupby("scenario", sort=False)[spent.column].agg(["min", "max"])
    apart = [
        f"{scenario}: missions were given up after {row['min']} to {row['max']} {spent.name}; all "
        f"of them count as {row['max']}."
        for scenario, row in ends[ends["min"] < ends["max"]].iterrows()
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

    Columns: those of ``by``; ``missions`` and ``scenarios``, how many; the mean of each measure
    under the name of its column, with ``_low`` and ``_high``; ``finished`` or ``terminated``, a
    share; ``faults`` and ``seconds``, in all, if they are known. The bounds are 95 % intervals of
    the stratified bootstrap, seeds drawn anew within scenarios; they are NaN where no scenario has
    two missions, or where all are alike. Missions without a value (NaN) are left out of its mean.

    Args:
        missions: one row per mission.
        measures: what methods are compared by.
        by: columns that say which missions belong together, such as ``("scenario", "method")``.

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


def aggregate(missions: pd.DataFrame, measures: Measures, oracle: str) -> pd.DataFrame:
    """Return :func:`summarise` with more columns.

    Interquartile means of each measure (``COLUMN_iqm``); if there is a budget, the geometric mean
    of what was spent over what the oracle spent, where it finished (``ratio``) and over all pairs
    (``ratio_all``), each with ``_low``, ``_high`` and ``_pairs``; ``per_hour``, missions per hour
    of computing, of those whose time was counted.
    """
    rows = summarise(missions, measures).to_dict("records")
    for row in rows:
        own = missions[missions["method"] == row["method"]]
        for measure in measures:
            name = f"{measure.column}_iqm"
            row |= estimate(name, own[measure.column], own["scenario"], interquartile_mean)
        if measures.budget and oracle in set(missions["method"]):
            pairs = pair(missions, row["method"], oracle)
            finished = pairs[pairs["finished_other"].astype(bool)]
            for name, chosen in (("ratio", finished), ("ratio_all", pairs)):
                # Counted from 0: one more has been spent, and no logarithm is of nothing.
                spent = chosen[measures.budget.column] + 1
                logs = np.log(spent / (chosen[f"{measures.budget.column}_other"] + 1))
                entries = estimate(name, logs, chosen["scenario"])
                row |= {key: float(np.exp(value)) for key, value in entries.items()}
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
    """Return one row per baseline and other method that share a scenario.

    Columns: ``baseline``, ``method``, ``pairs``; means of paired differences of each measure under
    its column's name (NaN without pairs), and ``better``, the probability of improvement, each
    with ``_low`` and ``_high``.
    """
    rows = []
    groups = dict(iter(rank_missions(missions, measures).groupby("method", sort=False)))
    for baseline in (name for name in baselines if name in groups):
        for method, group in groups.items():
            other = groups[baseline]
            if method == baseline or not set(group["scenario"]) & set(other["scenario"]):
                continue
            pairs = pair(missions, str(method), baseline)
            row = {"baseline": baseline, "method": method, "pairs": len(pairs)}
            for column in (measure.column for measure in measures):
                apart = pairs[column] - pairs[f"{column}_other"]
                row |= estimate(column, apart, pairs["scenario"])
            row["better"], ends = probability_of_improvement(group, other)
            row["better_low"], row["better_high"] = ends
            rows.append(row)
    return pd.DataFrame(rows)
