"""Tables as files: for programs, for papers, for readers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import pandas as pd

from afm_rl.storage.csv_text import csv_text
from afm_rl.storage.measures import Measure

# What LaTeX writes another way; the escapes of pandas leave these alone.
LATEX = {"±": r"$\pm$", "∞": r"$\infty$"}
Places = frozenset[tuple[int, int]]
ESCAPES = str.maketrans(
    {sign: f"\\{sign}" for sign in "%_#&${}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
)


@dataclass(frozen=True)
class Table:
    """One table: its numbers, and how they are shown.

    Attributes:
        name: file name, without an ending.
        title: what it is about.
        note: how to read it.
        numbers: for programs; becomes the CSV file.
        shown: the same for people: text, one column per head; becomes LaTeX and HTML.
        bold: places ``(row, column)`` of ``shown`` that stand out.
        align: LaTeX's letters for the columns; empty for text and then numbers.
    """

    name: str
    title: str
    note: str
    numbers: pd.DataFrame
    shown: pd.DataFrame
    bold: Places = field(default_factory=frozenset)
    align: str = ""

    def to_csv(self) -> str:
        """Return the numbers as CSV."""
        return csv_text(self.numbers)

    def to_latex(self) -> str:
        """Return the table as LaTeX, to be set with the package ``booktabs``."""
        looks = self.shown.copy()
        for column in looks:
            looks[column] = ""
        for row, column in self.bold:
            looks.iat[row, column] = "textbf:--rwrap;"
        style = self.shown.style.apply(lambda _: looks, axis=None).hide(axis="index")
        style = style.format(escape="latex").format_index(escape="latex", axis=1)
        text = style.to_latex(
            hrules=True,
            column_format=self.align or "l" + "r" * (self.shown.shape[1] - 1),
            caption=f"{self.title}. {self.note}".translate(ESCAPES),
            label=f"tab:{self.name}",
            position_float="centering",
        )
        for sign, command in LATEX.items():
            text = text.replace(sign, command)
        return text


def number(value: float, digits: int = 0) -> str:
    """Return a number as text; a dash if there is none.

    >>> number(0.1234, 2), number(math.nan), number(math.inf)
    ('0.12', '-', '∞')
    """
    if math.isnan(value):
        return "-"
    return "∞" if value == math.inf else f"{value:.{digits}f}"


def interval_text(measure: Measure, row: Mapping[str, float], name: str, digits: int) -> str:
    """Return an entry of a row as text, in the unit of a measure, with its interval.

    >>> share = Measure("share", "share", "share", "%", scale=100)
    >>> interval_text(share, {"a": 0.5, "a_low": 0.4, "a_high": 0.6}, "a", 1)
    '50.0 [40.0, 60.0]'
    """
    middle, low, high = (
        measure.text(row[key], digits) for key in (name, f"{name}_low", f"{name}_high")
    )
    return middle if low == "-" else f"{middle} [{low}, {high}]"


def best_places(values: pd.DataFrame, signs: Mapping[str, int]) -> Places:
    """Return the places of the best value of each column, unless all are alike.

    Args:
        values: numbers, one row per row of the table.
        signs: 1 for each column of ``values`` in which the highest is best, -1 for the lowest;
            in this order they are the table's columns from the third on.
    """
    places = set()
    for place, (name, sign) in enumerate(signs.items(), 2):
        column = sign * values[name].reset_index(drop=True)
        if column.nunique() > 1:
            places |= {(int(row), place) for row in column.index[column == column.max()]}
    return frozenset(places)
