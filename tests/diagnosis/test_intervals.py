"""Intervals hold what they promise."""

import numpy as np
import pytest

from afm_rl.diagnosis.intervals import half_widths, independence


def series(rng, rows, keep):
    """Return red noise of variance 1, ``(rows, 400)``."""
    found = rng.standard_normal((rows, 400))
    for k in range(1, rows):
        found[k] = keep * found[k - 1] + np.sqrt(1 - keep**2) * found[k]
    return found


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.9])
def test_the_interval_of_a_slope_holds_95_percent(keep):
    """Of 400 slopes 95 % are inside: with a chance of .999 at least 365."""
    rng = np.random.default_rng(0)
    u, residual = series(rng, 600, 0.9), series(rng, 600, keep)
    slope = (u * residual).sum(0) / (u**2).sum(0)  # of the truth 0
    widths = half_widths(u * (residual - slope * u) / (u**2).sum(0), chosen=1.0)
    assert 365 <= (np.abs(slope) < widths).sum() < 400


def test_residuals_of_steps_that_hold_count_as_few():
    steps = np.repeat(np.random.default_rng(0).standard_normal(40), 100)
    noise = 0.01 * np.random.default_rng(1).standard_normal(4000)
    assert independence(steps + noise) * 4000 < 150
    assert independence(noise) > 0.7
