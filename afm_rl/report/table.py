"""One table and its views: CSV, LaTeX, a terminal; the page has its own, in ``page.html``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pandas as pd
from rich import box
from rich.table import Table as Grid
from rich.text import Text

from afm_rl.storage.csv_text import csv_text

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

    def to_grid(self, columns: Sequence[int] | None = None, caption: str | None = None) -> Grid:
        """Return some columns of the table, or all, for the terminal."""
        grid = Grid(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False, caption=caption)
        chosen = range(self.shown.shape[1]) if columns is None else columns
        for column in chosen:
            grid.add_column(Text(self.shown.columns[column]), justify="right" if column else "left")
        for row, texts in enumerate(self.shown.to_numpy()):
            looks = ("bold" if (row, column) in self.bold else "" for column in chosen)
            grid.add_row(*(Text(texts[c], look) for c, look in zip(chosen, looks, strict=True)))
        return grid


def number(value: float, digits: int = 0) -> str:
    """Return a number as text; a dash if there is none.

    >>> number(0.1234, 2), number(math.nan), number(math.inf)
    ('0.12', '-', '∞')
    """
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.{digits}f}"


def interval_text(
    row: Mapping[str, float], name: str, digits: int, scale: float = 1.0, sign: str = ""
) -> str:
    """Return an entry of a row as text, with its interval.

    Args:
        row: has the entries ``name``, ``name_low`` and ``name_high``.
        name: of the entry.
        digits: after the point.
        scale: what the numbers are multiplied by.
        sign: ``"+"`` writes the sign of positive numbers, too.

    >>> row = {"a": 0.5, "a_low": -0.4, "a_high": 0.6}
    >>> interval_text(row, "a", 1, 100), interval_text(row, "a", 1, sign="+")
    ('50.0 [-40.0, 60.0]', '+0.5 [-0.4, +0.6]')
    """
    values = (row[key] for key in (name, f"{name}_low", f"{name}_high"))
    middle, low, high = (
        (sign if value >= 0 else "") + number(scale * value, digits) for value in values
    )
    return middle if low == "-" else f"{middle} [{low}, {high}]"
