"""Tables as files: for programs, for papers, for readers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import pandas as pd

# What LaTeX writes another way; the escapes of pandas leave these alone.
LATEX = {"±": r"$\pm$", "∞": r"$\infty$"}
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
    bold: frozenset[tuple[int, int]] = field(default_factory=frozenset)
    align: str = ""

    def to_csv(self) -> str:
        """Return the numbers as CSV."""
        return self.numbers.to_csv(index=False, lineterminator="\n")

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


def with_interval(value: float, low: float, high: float, digits: int = 0) -> str:
    """Return a number and its interval as text.

    >>> with_interval(1.0, 0.5, 2.0, 1), with_interval(1.0, math.nan, math.nan)
    ('1.0 [0.5, 2.0]', '1')
    """
    interval = "" if math.isnan(low) else f" [{number(low, digits)}, {number(high, digits)}]"
    return number(value, digits) + interval


def best_places(
    values: pd.DataFrame, better: Mapping[str, str], columns: Mapping[str, int]
) -> frozenset[tuple[int, int]]:
    """Return the places of the best value of each column, unless all are alike.

    Args:
        values: numbers, one row per row of the table.
        better: ``"max"`` or ``"min"`` for each column of ``values`` that has a best one.
        columns: where that column stands in the table as it is shown.
    """
    places = set()
    for name, choose in better.items():
        column = values[name].reset_index(drop=True)
        if column.nunique() > 1:
            best = column.agg(choose)
            places |= {(int(row), columns[name]) for row in column.index[column == best]}
    return frozenset(places)
