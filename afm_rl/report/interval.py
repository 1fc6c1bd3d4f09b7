"""How far a mean can be trusted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

LEVEL = 0.95
RESAMPLES = 4000


def mean_interval(values: ArrayLike, level: float = LEVEL) -> tuple[float, float]:
    """Return a percentile bootstrap interval of the mean, the same one at each call.

    One value, or values that are all the same, say nothing about the spread: the interval
    is then NaN at both ends.

    Args:
        values: the sample, ``(N,)``.
        level: how often such intervals hold the mean.

    >>> low, high = mean_interval([0.0, 1.0] * 50)
    >>> 0.38 < low < 0.42, 0.58 < high < 0.62
    (True, True)
    >>> mean_interval([1.0, 1.0])
    (nan, nan)
    """
    sample = np.asarray(values, dtype=float)
    if len(sample) < 2 or np.ptp(sample) == 0:
        return math.nan, math.nan
    means = np.random.default_rng(0).choice(sample, (RESAMPLES, len(sample))).mean(-1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
