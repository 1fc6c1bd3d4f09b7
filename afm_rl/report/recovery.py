"""How soon a model predicts well again after the regime has changed."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from afm_rl.report.table import Table, number

STAY = 20  # steps that the error must stay low
QUANTILE, FACTOR = 0.95, 1.5  # of the errors before the first change: the nominal level
FLOOR = 1e-4  # m, rad: below this every robot counts as well predicted
NOTE = (
    f"Steps from a change of the regime until the one-step prediction error has come under the "
    f"nominal level and stays there for {STAY} steps. The nominal level of a mission is {FACTOR} "
    f"times the {100 * QUANTILE:.0f}th percentile of its errors before the first change, at least "
    f"{FLOOR:g}. The median is over all changes, those never recovered from included as ∞; "
    f"changes with fewer than {STAY} steps to the next one or to the end cannot tell and are left "
    "out. This measures the model: a method that corrects actions over a frozen model may drive "
    "well and never recover."
)


def recovery_times(steps: pd.DataFrame) -> pd.DataFrame:
    """Return one row per change of the regime: ``change`` (from 1) and ``time`` (steps).

    ``time`` is 0 where the error never left the nominal level, inf where it stays above it
    until the next change or the end. Changes that are too near to those are left out, and so
    is a mission that changes at once: it shows no nominal level.

    Args:
        steps: one mission's steps, in order.

    >>> active, error = [0] * 30 + [1] * 50, [1e-3] * 30 + [1] * 7 + [1e-3] * 43
    >>> steps = pd.DataFrame({"regime_active": active, "error": error})
    >>> recovery_times(steps).to_dict("records")
    [{'change': 1, 'time': 7.0}]
    """
    active, error = steps["regime_active"].to_numpy(), steps["error"].to_numpy(dtype=float)
    changes = np.flatnonzero(np.diff(active)) + 1
    rows = []
    if len(changes):
        level = max(FLOOR, FACTOR * float(np.quantile(error[: changes[0]], QUANTILE)))
        for count, (start, end) in enumerate(zip(changes, [*changes[1:], len(error)], strict=True)):
            if end - start >= STAY:
                low = sliding_window_view(error[start:end] <= level, STAY).all(-1)
                time = float(low.argmax()) if low.any() else np.inf
                rows.append({"change": count + 1, "time": time})
    return pd.DataFrame(rows, columns=["change", "time"])


def recovery_table(times: pd.DataFrame) -> Table:
    """Return medians per method and change.

    Args:
        times: rows of :func:`recovery_times` with a column ``method``; at least one.
    """
    rows = []
    for (method, change), group in times.groupby(["method", "change"], sort=False):
        quartiles = group["time"].quantile([0.25, 0.5, 0.75], interpolation="lower")
        rows.append(
            {
                "method": method,
                "change": change,
                "changes": len(group),
                "never": float(np.isinf(group["time"]).mean()),
                "median": float(quartiles[0.5]),
                "lower_quartile": float(quartiles[0.25]),
                "upper_quartile": float(quartiles[0.75]),
            }
        )
    numbers = pd.DataFrame(rows)
    shown = pd.DataFrame(
        {
            "method": numbers["method"],
            "change": numbers["change"].astype(str),
            "changes seen": numbers["changes"].astype(str),
            "never recovered %": [number(100 * share) for share in numbers["never"]],
            "median steps": numbers["median"].map(number),
            "quartiles": numbers["lower_quartile"].map(number)
            + " to "
            + numbers["upper_quartile"].map(number),
        }
    )
    return Table("recovery", "Recovery after each change of the regime", NOTE, numbers, shown)
