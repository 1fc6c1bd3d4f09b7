"""Tables of means over missions."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from afm_rl.report.frames import cell_names
from afm_rl.report.interval import mean_interval
from afm_rl.report.kinds import kind_of


def summarise(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one row per method, in the order in which they first occur.

    Columns: ``method``; ``missions``, how many; ``success``, the mean share of targets
    reached, with ``success_low`` and ``success_high``; ``finished``, the share of missions
    that reached every target; ``steps``, the mean number of steps, with ``steps_low`` and
    ``steps_high`` (a mission that was given up counts with the steps it was given);
    ``seconds``, in all. Flights have the errors of :data:`~afm_rl.report.kinds.FLIGHTS` in place
    of success and steps. The bounds are 95 % bootstrap intervals over missions, NaN where
    there is only one mission or where all are alike.

    Args:
        missions: one row per mission.

    >>> row = {"method": "physics", "seconds": 2.0}
    >>> good = row | {"success_rate": 1.0, "finished": True, "steps": 300}
    >>> poor = row | {"success_rate": 0.5, "finished": False, "steps": 500}
    >>> summarise(pd.DataFrame([good, poor]))[["success", "finished", "steps"]].values.tolist()
    [[0.75, 0.5, 400.0]]
    """
    return _means(missions, ["method"])


def summarise_cells(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one row per cell (track and regime) and method, like :func:`summarise`."""
    return _means(missions.assign(cell=cell_names(missions)), ["cell", "method"])


def _means(missions: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    groups = missions.groupby(list(by), sort=False)
    return pd.DataFrame([dict(zip(by, key, strict=True)) | _mean(group) for key, group in groups])


def _mean(group: pd.DataFrame) -> dict[str, float]:
    row: dict[str, float] = {"missions": len(group)}
    for place, measure in enumerate(kind_of(group).measures):
        low, high = mean_interval(group[measure.column])
        row[measure.name] = float(group[measure.column].astype(float).mean())
        row |= {f"{measure.name}_low": low, f"{measure.name}_high": high}
        if place == 0:
            row["finished"] = float(group["finished"].mean())
    return row | {"seconds": float(group["seconds"].sum())}
