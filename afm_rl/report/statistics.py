"""Intervals for missions that fall into cells: the stratified bootstrap (Agarwal et al. 2021).

Cells are given, seeds are chance: only the missions within a cell are drawn anew.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import bootstrap, trim_mean

Bounds = tuple[float, float]


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half (Agarwal et al. 2021).

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 99.0])))
    1.5
    """
    return trim_mean(values, 0.25, axis=axis)


def stratified_interval(
    values: ArrayLike, strata: ArrayLike, statistic: Callable[..., np.ndarray] = np.mean
) -> Bounds:
    """Return the 95 % percentile bootstrap interval of a statistic, resampled within strata.

    The draws are the same at each call. Where no draw changes the statistic, as with one mission
    per stratum, the interval is NaN at both ends.

    Args:
        values: the sample, ``(N,)``.
        strata: the cell of each, ``(N,)``.
        statistic: takes ``(R, N)`` and ``axis``, returns ``(R,)``.

    >>> low, high = stratified_interval([0.0, 1.0] * 50, ["a"] * 100)
    >>> 0.38 < low < 0.42, 0.58 < high < 0.62
    (True, True)
    >>> stratified_interval([0.0, 1.0] * 50, ["a", "b"] * 50)  # each cell has one value only
    (nan, nan)
    """
    sample = np.asarray(values, dtype=float)

    def whole(samples: list[np.ndarray]) -> np.ndarray:
        return statistic(np.concatenate(samples, -1), axis=-1)

    low, high = resampled_bounds(split(sample, strata), whole)
    return float(low), float(high)


def estimate(
    name: str,
    values: pd.Series,
    strata: pd.Series,
    statistic: Callable[..., np.ndarray] = np.mean,
) -> dict[str, float]:
    """Return a statistic and its interval as entries of a row; missing values are left out.

    >>> estimate("a", pd.Series([1.0, 3.0, math.nan]), pd.Series(["x", "y", "y"]))
    {'a': 2.0, 'a_low': nan, 'a_high': nan}
    """
    known = values.notna()
    sample = values[known].to_numpy(dtype=float)
    low, high = stratified_interval(sample, strata[known], statistic)
    middle = float(statistic(sample)) if len(sample) else math.nan
    return {name: middle, f"{name}_low": low, f"{name}_high": high}


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

    size = work * sum(sample.size for sample in samples)
    found = bootstrap(
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
    draws = found.bootstrap_distribution
    alike = np.ptp(draws, -1) < 1e-12 * np.maximum(1.0, np.abs(draws).max(-1))
    return np.where(alike, math.nan, np.stack(found.confidence_interval))


def probability_of_improvement(mine: pd.DataFrame, other: pd.DataFrame) -> tuple[float, Bounds]:
    r"""Return :math:`P(X > Y)` with its 95 % interval (Agarwal et al. 2021).

    .. math:: \frac{1}{C} \sum_c \frac{1}{n_c m_c} \sum_{i, j}
              [x_{ci} > y_{cj}] + \tfrac{1}{2} [x_{ci} = y_{cj}]

    Within each cell that both methods have, every mission of one meets every mission of the
    other, whatever their seeds; cells count alike. The interval draws the missions of both
    anew within cells. NaN if no cell is shared.

    Args:
        mine: missions of one method, with ``cell`` and ``rank``.
        other: those of the other one.

    >>> mine = pd.DataFrame({"cell": ["a", "a"], "rank": [1, 3]})
    >>> probability_of_improvement(mine, pd.DataFrame({"cell": ["a"], "rank": [1]}))[0]
    0.75
    """
    ranks = [frame.groupby("cell")["rank"].agg(np.array) for frame in (mine, other)]
    cells = ranks[0].index.intersection(ranks[1].index)
    if cells.empty:
        return math.nan, (math.nan, math.nan)

    def share_won(samples: list[np.ndarray]) -> np.ndarray:
        pairs = zip(samples[: len(cells)], samples[len(cells) :], strict=True)
        won = [0.5 * (np.sign(x[..., None] - y[..., None, :]) + 1) for x, y in pairs]
        return np.mean([part.mean((-2, -1)) for part in won], axis=0)

    samples = [rank[cell].astype(float) for rank in ranks for cell in cells]
    low, high = resampled_bounds(samples, share_won, work=max(map(len, samples)))
    return float(share_won(samples)), (float(low), float(high))
