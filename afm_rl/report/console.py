"""Summary tables for a terminal."""

from __future__ import annotations

from typing import IO

import pandas as pd
from rich import box
from rich.console import Console, JustifyMethod
from rich.table import Table as Grid
from rich.text import Text

from afm_rl.report.comparisons import cell_table, summary_table
from afm_rl.report.summary import summarise
from afm_rl.report.table import Table
from afm_rl.storage.measures import Measures

ABREAST = 6  # methods side by side in a table of cells; more get a table below
WIDE = 1000  # columns: numbers that are cut off are worse than lines that wrap


def print_summary(missions: pd.DataFrame, measures: Measures, file: IO[str] | None = None) -> None:
    """Print the table of methods, then one of cells x methods if there are several cells.

    In a terminal the best values are bold; a pipe or a file gets plain text. The tables are those
    of the report, intervals included.

    Args:
        missions: one row per mission.
        measures: what methods are compared by.
        file: where to; standard output if none is given.

    >>> from afm_rl.storage.measures import Measure
    >>> steps = Measures((Measure("steps", "steps", "steps", better="lower"),))
    >>> row = {"method": "physics", "track": "oval", "seed": 0, "steps": 300, "finished": True}
    >>> print_summary(pd.DataFrame([row]), steps)  # doctest: +NORMALIZE_WHITESPACE
    <BLANKLINE>
     method   missions  finished (%)  steps
     ──────────────────────────────────────
     physics         1           100    300
    <BLANKLINE>
    """
    console = Console(file=file, width=WIDE, highlight=False)
    table = summary_table(summarise(missions, measures), measures)
    some = table.shown.apply(lambda texts: texts.str.contains("[", regex=False)).any(axis=None)
    caption = "mean [95 % interval, seeds drawn anew within cells]" if some else None
    console.print(_grid(table, list(range(table.shown.shape[1])), caption))
    cells = cell_table(missions, measures)
    if len(cells.shown) > 1:
        caption = f"{' / '.join(measure.head for measure in measures.headlines)}, means"
        columns = range(1, cells.shown.shape[1])
        for first in range(0, len(columns), ABREAST):
            console.print(_grid(cells, [0, *columns[first : first + ABREAST]], caption))


def _grid(table: Table, columns: list[int], caption: str | None) -> Grid:
    """Return some columns of a table for the terminal."""
    grid = Grid(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False, caption=caption)
    for column in columns:
        justify: JustifyMethod = "right" if column else "left"
        grid.add_column(Text(table.shown.columns[column]), justify=justify)
    for place, texts in enumerate(table.shown.to_numpy()):
        bold = ("bold" if (place, column) in table.bold else "" for column in columns)
        grid.add_row(*(Text(texts[c], look) for c, look in zip(columns, bold, strict=True)))
    return grid
