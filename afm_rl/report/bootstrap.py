"""Intervals for missions that fall into cells."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import trim_mean

from afm_rl.report.interval import LEVEL

RESAMPLES = 2000
Bounds = tuple[float, float]


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return the mean of the middle half (Agarwal et al. 2021).

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 99.0])))
    1.5
    """
    return trim_mean(values, 0.25, axis=axis)


def resample(strata: ArrayLike, count: int = RESAMPLES) -> np.ndarray:
    """Return places ``(count, N)`` drawn with replacement within each stratum ``(N,)``.

    The draws are the same at each call.

    >>> drawn = resample(["a", "b", "b", "a"])
    >>> drawn.shape, np.unique(drawn[:, 0]).tolist(), np.unique(drawn[:, 1]).tolist()
    ((2000, 4), [0, 3], [1, 2])
    """
    _, stratum, sizes = np.unique(np.asarray(strata), return_inverse=True, return_counts=True)
    order, starts = np.argsort(stratum, kind="stable"), np.cumsum(sizes) - sizes
    uniform = np.random.default_rng(0).random((count, len(stratum)))
    return order[starts[stratum] + (uniform * sizes[stratum]).astype(int)]


def stratified_interval(
    values: ArrayLike,
    strata: ArrayLike,
    statistic: Callable[..., np.ndarray] = np.mean,
    level: float = LEVEL,
) -> Bounds:
    """Return a percentile bootstrap interval of a statistic, resampled within strata.

    Cells are given, seeds are chance: only the seeds within a cell are drawn anew. Where no
    draw changes the statistic the interval is NaN at both ends.

    Args:
        values: the sample, ``(N,)``.
        strata: the cell of each, ``(N,)``.
        statistic: takes ``(R, N)`` and ``axis``, returns ``(R,)``.
        level: how often such intervals hold the statistic.

    >>> low, high = stratified_interval([0.0, 1.0] * 50, ["a", "b"] * 50)
    >>> low, high  # each cell has one value only
    (nan, nan)
    """
    sample = np.asarray(values, dtype=float)
    if not len(sample):
        return math.nan, math.nan
    return bounds(statistic(sample[resample(strata)], axis=-1), level)


def bounds(statistics: np.ndarray, level: float = LEVEL) -> Bounds:
    """Return the percentile interval of resampled statistics ``(R,)``; NaN if all are alike."""
    if np.ptp(statistics) < 1e-12 * max(1.0, float(np.abs(statistics).max())):
        return math.nan, math.nan
    low, high = np.quantile(statistics, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
