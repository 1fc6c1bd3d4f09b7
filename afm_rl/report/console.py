"""The tables of a run in a terminal."""

from __future__ import annotations

from typing import IO

import pandas as pd
from rich.console import Console

from afm_rl.report.means import summarise
from afm_rl.report.tables import cell_table, summary_table
from afm_rl.storage.measures import Measures

WIDE = 1000  # columns: numbers that are cut off are worse than lines that wrap


def print_summary(
    missions: pd.DataFrame, measures: Measures, file: IO[str] | None = None, abreast: int = 6
) -> None:
    """Print the table of methods, then one of cells x methods if there are several cells.

    In a terminal the best values are bold; a pipe or a file gets plain text. The tables are those
    of the report, intervals included.

    Args:
        missions: one row per mission.
        measures: what methods are compared by.
        file: where to; standard output if none is given.
        abreast: methods side by side in a table of cells; more get a table below.

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
    console.print(table.to_grid(caption=caption))
    cells = cell_table(missions, measures)
    if len(cells.shown) > 1:
        caption = f"{' / '.join(measure.head for measure in measures.headlines)}, means"
        columns = range(1, cells.shown.shape[1])
        for first in range(0, len(columns), abreast):
            console.print(cells.to_grid([0, *columns[first : first + abreast]], caption))
