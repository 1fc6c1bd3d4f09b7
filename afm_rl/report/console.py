"""Summary tables for a terminal."""

from __future__ import annotations

import math
from typing import IO

import pandas as pd
from rich import box
from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from afm_rl.report.kinds import Kind, kind_of
from afm_rl.report.summary import summarise, summarise_cells

ABREAST = 6  # methods side by side in a table of cells; more get a table below
WIDE = 1000  # columns: numbers that are cut off are worse than lines that wrap


def print_summary(missions: pd.DataFrame, file: IO[str] | None = None) -> None:
    """Print the table of methods, then one of cells x methods if there are several cells.

    In a terminal the best values are bold; a pipe or a file gets plain text.

    Args:
        missions: one row per mission.
        file: where to; standard output if none is given.

    >>> row = {"method": "physics", "track": "oval", "seed": 0, "seconds": 2.0}
    >>> print_summary(pd.DataFrame([row | {"success_rate": 1.0, "finished": True, "steps": 300}]))
    <BLANKLINE>
     method   missions  success %  finished %  steps  seconds
     ────────────────────────────────────────────────────────
     physics         1      100.0         100    300      2.0
    <BLANKLINE>
    """
    console = Console(file=file, width=WIDE, highlight=False)
    cells, kind = summarise_cells(missions), kind_of(missions)
    console.print(_table(summarise(missions), kind))
    if cells["cell"].nunique() > 1:
        methods = list(dict.fromkeys(cells["method"]))
        for first in range(0, len(methods), ABREAST):
            console.print(_grid(cells, kind, methods[first : first + ABREAST]))


def _grid(cells: pd.DataFrame, kind: Kind, methods: list[str]) -> Table:
    """Return one row per cell: what counts, of some methods, the best one of all bold."""
    heads = [measure.head.removesuffix(" %") for measure in kind.measures[: len(kind.short)]]
    caption = f"{' and '.join(heads)}, means"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, caption=caption)
    table.add_column("cell")
    for method in methods:
        table.add_column(method, justify="right")
    for cell, group in cells.groupby("cell", sort=False):
        rows = group.to_dict("records")
        rank = {row["method"]: kind.rank(row) for row in rows}
        texts = {row["method"]: kind.cell(row) for row in rows}
        best = max(rank.values()) if len(set(rank.values())) > 1 else None
        table.add_row(
            str(cell),
            *(Text(texts.get(m, "-"), "bold" * (rank.get(m) == best)) for m in methods),
        )
    return table


def _table(means: pd.DataFrame, kind: Kind) -> Table:
    """Return a table of what :func:`summarise` gave; the best of several methods are bold."""
    texts = _texts(means, kind)
    some = bool(means[[f"{each.name}_low" for each in kind.measures]].notna().any(axis=None))
    heads = {"finished": "finished %"} | {each.name: each.head for each in kind.measures}
    better = {"finished": max} | {each.name: each.best for each in kind.measures}
    table = Table(
        box=box.SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
        caption="mean [95 % interval]" if some else None,
    )
    for name in texts:
        justify: JustifyMethod = "left" if name == "method" else "right"
        table.add_column(heads.get(name, name), justify=justify)
    best = {
        name: choose(means[name]) for name, choose in better.items() if means[name].nunique() > 1
    }
    for place, row in texts.iterrows():
        bold = {name for name, value in best.items() if means.loc[place, name] == value}
        table.add_row(*(Text(text, "bold" * (name in bold)) for name, text in row.items()))
    return table


def _texts(means: pd.DataFrame, kind: Kind) -> pd.DataFrame:
    """Return the cells of the table as text."""
    rows = []
    for row in means.to_dict("records"):
        texts = {"method": row["method"], "missions": f"{row['missions']}"}
        for place, each in enumerate(kind.measures):
            values = (each.scale * row[each.name + end] for end in ("", "_low", "_high"))
            texts[each.name] = _number(each.digits, *values)
            if place == 0:
                texts["finished"] = f"{100 * row['finished']:.0f}"
        rows.append(texts | {"seconds": f"{row['seconds']:.1f}"})
    return pd.DataFrame(rows, index=means.index)


def _number(digits: int, mean: float, low: float, high: float) -> str:
    interval = "" if math.isnan(low) else f" [{low:.{digits}f}, {high:.{digits}f}]"
    return f"{mean:.{digits}f}{interval}"
