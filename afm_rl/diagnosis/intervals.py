"""Intervals that hold where residuals are not independent of each other."""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit


def half_widths(influence: np.ndarray, chosen: float = 1.25) -> np.ndarray:
    r"""Return half widths ``(P,)`` of 95 % intervals.

    The variance of the sum of N influences is N times their spectral density at frequency 0, which
    an autoregression of their own order gives, :math:`\sigma^2 / (1 - \sum_i \phi_i)^2` (Andrews
    and Monahan 1992; Den Haan and Levin 1997). Student's quantile is that of as many rows as would
    tell as much if they were independent.

    Args:
        influence: of each row on each parameter, ``(N, P)``: the estimate minus the truth is their
            sum.
        chosen: times the usual interval, where the same rows chose the model; set by simulated
            logs.

    >>> noise = np.random.default_rng(0).standard_normal((10000, 1))
    >>> half_widths(noise / 10000, chosen=1.0).round(2)
    array([0.02])
    """
    rows = len(influence)
    widths = []
    for series in np.ascontiguousarray((influence - influence.mean(0)).T):
        power = float(series @ series) / rows
        if not power > 0:
            widths.append(0.0)
            continue
        density = _density_at_zero(series, power)
        effective = max(rows * min(power / density, 1.0) - len(influence.T), 3.0)
        widths.append(stdtrit(effective, 0.975) * np.sqrt(rows * density))
    return chosen * np.array(widths)


def independence(residual: np.ndarray) -> float:
    """Return how many independent rows a row of residuals ``(N,)`` counts as, at most 1."""
    power = float(residual @ residual) / len(residual)
    return min(1.0, power / _density_at_zero(residual, power)) if power > 0 else 1.0


def _density_at_zero(series: np.ndarray, power: float) -> float:
    """Return the long-run variance, the largest of those that rows and means of rows show.

    Residuals of steps that hold for seconds are alike for hundreds of rows, which no
    autoregression of a few rows sees.
    """
    densities, rows = [], len(series)
    for width in (1, 5, 25):
        means = series[: rows // width * width].reshape(-1, width).mean(1)
        if width > 1 and len(means) < 40:
            break
        centred = means - means.mean()
        variance = float(centred @ centred) / len(centred)
        if variance > 0:
            densities.append(width * _autoregression(centred, variance))
    return max(densities, default=power)


def _autoregression(series: np.ndarray, power: float, most: int = 12, fresh: float = 0.03) -> float:
    """Return the long-run variance by the autoregression with the least AIC (Levinson)."""
    rows = len(series)
    order = max(min(most, rows // 10), 1)
    lags = np.array([(series[k:] * series[: rows - k]).sum() for k in range(order + 1)]) / rows
    # The first order counts in any case, without its bias in few rows (Kendall 1954).
    first = lags[1] / power
    first = min(first + (1 + 4 * first) / rows, 1 - fresh)
    least = power * (1 - first**2) / (1 - first) ** 2 if first > 0 else 0.3 * power
    best, density = 0.0, power
    coefficients, error = np.zeros(0), power
    for p in range(1, order + 1):
        reflection = (lags[p] - coefficients @ lags[p - 1 : 0 : -1]) / error
        coefficients = np.append(coefficients - reflection * coefficients[::-1], reflection)
        error *= 1 - reflection**2
        if not error > 0:
            break
        criterion = rows * np.log(error / power) + 2 * p
        if criterion < best:
            best = criterion
            density = error / max(1 - coefficients.sum(), fresh) ** 2
    return max(density, least)
