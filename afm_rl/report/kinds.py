"""Kinds of missions, by the columns of their table, and what counts in each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pandas as pd


@dataclass(frozen=True)
class Measure:
    """A column of the table of missions by which methods are compared.

    Attributes:
        column: its name in the table.
        name: its name in summaries.
        head: what tables call it.
        label: what axes call it.
        best: ``max`` or ``min``.
        scale: what numbers are multiplied by before they are shown.
        digits: digits after the point, in tables.
        limits: of axes; None for all that there is, from 0 on.
    """

    column: str
    name: str
    head: str
    label: str
    best: Callable[..., Any]
    scale: float = 1.0
    digits: int = 0
    limits: tuple[float, float] | None = None

    def rank(self, value: float) -> float:
        """Return a number that is the larger the better the value is.

        >>> FLIGHTS.measures[0].rank(0.5)
        -0.5
        """
        return value if self.best is max else -value


@dataclass(frozen=True)
class Kind:
    """What there is to say of a kind of missions.

    Attributes:
        missions: columns of its missions, from the seed on.
        steps: columns of its steps beside those that all have.
        measures: what methods are compared by, the most important one first.
        short: formats of those that fit into a table of cells and methods.
        final: columns of the missions for TensorBoard.
        units: those of the prediction error.
    """

    missions: tuple[str, ...]
    steps: tuple[str, ...]
    measures: tuple[Measure, ...]
    short: tuple[str, ...]
    final: tuple[str, ...]
    units: str

    def cell(self, row: Any) -> str:
        """Return the measures of a row of a summary as short text.

        >>> LAPS.cell(pd.Series({"success": 0.5, "steps": 400.0}))
        '50 %    400'
        """
        pairs = zip(self.short, self.measures, strict=False)
        return " ".join(form.format(each.scale * row[each.name]) for form, each in pairs)

    def rank(self, row: Any) -> tuple[float, ...]:
        """Return what is the larger the better a row of a summary is."""
        shown = self.measures[: len(self.short)]
        return tuple(each.rank(row[each.name]) for each in shown)


LAPS = Kind(
    ("seed", "success_rate", "steps", "reached", "targets", "finished", "seconds", "mission"),
    ("reached",),
    (
        Measure(
            *("success_rate", "success", "success %", "targets reached (%)", max),
            scale=100.0,
            digits=1,
            limits=(-4, 104),
        ),
        Measure("steps", "steps", "steps", "steps", min),
    ),
    ("{:.0f} %", "{:6.0f}"),
    ("success_rate", "steps"),
    "m, rad",
)
FLIGHTS = Kind(
    ("seed", "mse", "mse_z", "peak_z", "steps", "finished", "seconds", "mission"),
    ("square_error_x", "square_error_y", "square_error_z", "phase"),
    (
        Measure("mse", "mse", "MSE (m²)", "mean squared error (m²)", min, digits=5),
        Measure("mse_z", "mse_z", "MSE of z (m²)", "the same along z (m²)", min, digits=5),
    ),
    ("{:.5f}",),
    ("mse", "mse_z", "peak_z"),
    "m, m/s, rad, rad/s",
)


def kind_of(missions: pd.DataFrame) -> Kind:
    """Return what kind of missions a table holds.

    >>> kind_of(pd.DataFrame(columns=["seed", "mse"])) is FLIGHTS
    True
    """
    return FLIGHTS if "mse" in missions else LAPS
