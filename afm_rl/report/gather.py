"""What figures and tables need of the steps, read one method at a time."""

from __future__ import annotations

from collections.abc import Collection as AnyOf
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from afm_rl.report.collect import Collection
from afm_rl.report.recovery import recovery_times
from afm_rl.report.results_files import read_steps

COLUMNS = ["error", "miss", "unforeseen", "loss", "regime_active", "reached", "x", "y"]
TRACES = ["mission", "t", "error", "loss", "regime_active"]
POINTS = 240  # of each curve of progress


@dataclass
class Gathered:
    """Excerpts of the steps of all methods.

    Attributes:
        recovery: recovery times, with ``method``, ``cell``, ``seed``.
        grid: numbers of steps ``(G,)`` at which progress is known.
        progress: per method, the share of targets reached by then, ``(B, G)``, one row per
            mission in the order of ``missions``; methods without steps are not here.
        traces: error, loss and regime of the missions in ``traced``, step by step.
        places: where robots were (m), ``(N, 2)``, by cell and method.
    """

    grid: np.ndarray
    recovery: list[pd.DataFrame] = field(default_factory=list)
    progress: dict[str, np.ndarray] = field(default_factory=dict)
    missions: dict[str, pd.DataFrame] = field(default_factory=dict)
    traces: list[pd.DataFrame] = field(default_factory=list)
    places: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)


def gather(collection: Collection, traced: AnyOf[int], mapped: AnyOf[str]) -> Gathered:
    """Read the steps of each method in turn and keep excerpts.

    Args:
        collection: the results.
        traced: missions to keep errors and losses of.
        mapped: cells to keep places of.
    """
    known = collection.missions[collection.missions["file"] >= 0]
    gathered = Gathered(np.linspace(0, known["steps"].max() + 1 if len(known) else 1, POINTS))
    for method, missions in known.groupby("method", sort=False):
        steps = read_steps(collection.files, missions, COLUMNS)
        _excerpt(gathered, str(method), missions.set_index("mission"), steps, mapped)
        gathered.traces.append(steps.loc[steps["mission"].isin(list(traced)), TRACES])
    return gathered


def _excerpt(
    gathered: Gathered,
    method: str,
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    mapped: AnyOf[str],
) -> None:
    shares, order = [], []
    places: dict[str, list[np.ndarray]] = {}
    for number, rows in steps.groupby("mission"):
        mission = missions.loc[number]
        shares.append(share_reached(rows, mission, gathered.grid))
        order.append(number)
        named = {"method": method, "cell": mission["cell"], "seed": mission["seed"]}
        gathered.recovery.append(recovery_times(rows).assign(**named))
        where = rows[["x", "y"]].to_numpy(dtype=float)
        where = where[np.isfinite(where).all(-1)]
        if mission["cell"] in mapped and len(where):
            places.setdefault(mission["cell"], []).append(where)
    if shares:
        gathered.progress[method] = np.array(shares)
        gathered.missions[method] = missions.loc[order]
    for cell, parts in places.items():
        gathered.places[cell, method] = np.concatenate(parts)


def share_reached(steps: pd.DataFrame, mission: pd.Series, grid: np.ndarray) -> np.ndarray:
    """Return the share of targets reached once ``grid`` ``(G,)`` steps have been made.

    After the mission's last step the share stays what it was at its end.

    >>> steps = pd.DataFrame({"t": [0, 1, 2], "reached": [0, 0, 1]})
    >>> share_reached(steps, pd.Series({"reached": 2, "targets": 2}), np.array([0, 2, 3, 9]))
    array([0. , 0.5, 1. , 1. ])
    """
    place = np.searchsorted(steps["t"], grid, side="right") - 1
    reached = steps["reached"].to_numpy(dtype=float)[np.maximum(place, 0)]
    reached[grid > steps["t"].iloc[-1]] = mission["reached"]
    return reached / mission["targets"]
