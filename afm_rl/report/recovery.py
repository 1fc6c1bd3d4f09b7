"""How soon a model predicts well again after the regime has changed."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from afm_rl.report.tables import Table
from afm_rl.storage.measures import number

STAY = 20  # steps that the error must stay low
MEASURES = {  # columns, by what they measure
    "miss": "motion",
    "unforeseen": "agent",
    "error": "model",
}
NOTE = (
    "Steps from a change of the regime until the one-step error is back under the nominal level "
    f"for the first time, and until it stays there for {STAY} steps. The nominal level of a "
    "mission is 1.5 times the 95th percentile of its errors before the first change, at least "
    "0.0001. Medians are over all changes, those never recovered from included as ∞; "
    f"changes with fewer than {STAY} steps to the next one or to the end are left "
    "out. Three errors: that of the motion, against the plan; "
    "that of the agent, against the prediction of model and correction together; and that of the "
    "model alone, against what it predicts of the action that was executed. A method that corrects "
    "actions over a frozen model recovers in the first two, and its model never does."
)


def recovery_times(steps: pd.DataFrame) -> pd.DataFrame:
    """Return one row per change and measure: ``of``, ``change`` (from 1), ``first``, ``time``.

    ``first`` and ``time`` are steps until the error is under the nominal level and until it stays
    there: 0 where it never left, inf where it does not happen until the next change or the end.
    Changes that are too near to those are left out, and so is a mission that changes at once: it
    shows no nominal level.

    Args:
        steps: one mission's steps, in order; a column that is missing is left out.

    >>> active, error = [0] * 30 + [1] * 50, [1e-3] * 30 + [1] * 7 + [1e-3] * 43
    >>> steps = pd.DataFrame({"regime_active": active, "error": error})
    >>> recovery_times(steps).to_dict("records")
    [{'of': 'model', 'change': 1, 'first': 7.0, 'time': 7.0}]
    """
    active = steps["regime_active"].to_numpy() if len(steps) else []
    changes, rows = np.flatnonzero(np.diff(active)) + 1, []
    for column, of in MEASURES.items():
        if len(changes) and column in steps and steps[column].notna().all():
            times = _times(steps[column].to_numpy(dtype=float), changes)
            rows += [(of, *row) for row in times]
    table = pd.DataFrame(rows, columns=["of", "change", "first", "time"])
    kinds = {"change": int, "first": float, "time": float}
    return table.astype(kinds)  # also without rows: tables are joined


def _times(
    error: np.ndarray, changes: np.ndarray, factor: float = 1.5, floor: float = 1e-4
) -> list[tuple[int, float, float]]:
    """Return changes, from 1, and their two times."""
    level = max(floor, factor * float(np.quantile(error[: changes[0]], 0.95)))
    times = []
    for count, (start, end) in enumerate(zip(changes, [*changes[1:], len(error)], strict=True)):
        if end - start >= STAY:
            low = error[start:end] <= level
            stays = sliding_window_view(low, STAY).all(-1)
            first, time = (float(f.argmax()) if f.any() else np.inf for f in (low, stays))
            times.append((count + 1, first, time))
    return times


def recovery_table(times: pd.DataFrame) -> Table:
    """Return medians per method, measure and change."""

    def share(of: float) -> object:
        return lambda steps: steps.quantile(of, interpolation="lower")

    by = times.groupby(["method", "of", "change"], sort=False)
    numbers = by.agg(
        changes=("time", "size"),
        first=("first", share(0.5)),
        median=("time", share(0.5)),
        lower_quartile=("time", share(0.25)),
        upper_quartile=("time", share(0.75)),
        never=("time", lambda steps: float(np.isinf(steps).mean())),
    ).reset_index()
    low, high = (numbers[f"{end}_quartile"].map(number) for end in ("lower", "upper"))
    heads = {
        "method": numbers["method"],
        "of the": numbers["of"],
        "change": numbers["change"].astype(str),
        "changes seen": numbers["changes"].astype(str),
        "first, median steps": numbers["first"].map(number),
        "to stay, median steps": numbers["median"].map(number),
        "quartiles": low + " to " + high,
        "never %": (100 * numbers["never"]).map(number),
    }
    title = "Recovery after each change of the regime"
    return Table("recovery", title, NOTE, numbers, pd.DataFrame(heads))
