"""What is not there."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from afm_rl.report.collect import KEY
from afm_rl.report.table import Table

NOTE = (
    "Every method is expected to have every cell and seed that any method has, and all that the "
    "studies asked for."
)
SOME = 3  # cells that a line in the terminal names


def find_absent(missions: pd.DataFrame, asked: pd.DataFrame) -> pd.DataFrame:
    """Return what is missing, one row per ``method``, ``cell`` and ``seed``.

    Args:
        missions: what there is, with ``cell``.
        asked: what studies asked for, with the same three columns.

    >>> there = pd.DataFrame({"method": ["a", "b", "b"], "cell": ["oval"] * 3, "seed": [0, 0, 1]})
    >>> find_absent(there, there[:0]).to_dict("records")
    [{'method': 'a', 'cell': 'oval', 'seed': 1}]
    """
    wanted = pd.concat([missions[KEY], asked[KEY]])
    places = wanted[["cell", "seed"]].drop_duplicates()
    every = wanted[["method"]].drop_duplicates().merge(places, how="cross")
    both = every.merge(missions[KEY], how="left", on=KEY, indicator=True)
    return both.loc[both["_merge"] == "left_only", KEY].reset_index(drop=True)


def absent_table(absent: pd.DataFrame, cells: int) -> Table:
    """Return the table of what is missing, one row per method and set of seeds.

    Args:
        absent: from :func:`find_absent`.
        cells: how many there are in all.
    """
    rows = []
    seeds = absent.groupby(["method", "cell"], sort=False)["seed"].agg(tuple).reset_index()
    for (method, numbers), group in seeds.groupby(["method", "seed"], sort=False):
        shown = ", ".join(map(str, numbers))
        rows.append(
            {
                "method": method,
                "missions": str(len(group) * len(numbers)),
                "seeds": shown,
                "cells": f"all {cells}" if len(group) == cells else "; ".join(group["cell"]),
            }
        )
    align = r"lrlp{0.6\textwidth}"
    return Table("missing", "Missing missions", NOTE, absent, pd.DataFrame(rows), align=align)


def absent_lines(absent: pd.DataFrame, methods: Sequence[str], cells: int) -> list[str]:
    """Say in one line per method what is missing; name a few cells.

    >>> absent = pd.DataFrame({"method": ["a", "a"], "cell": ["oval", "ring"], "seed": [1, 1]})
    >>> absent_lines(absent, ["a"], cells=3)
    ['missing: a: 2 missions in oval; ring']
    """
    lines = []
    for method, rows in absent.groupby("method", sort=False):
        names = rows["cell"].drop_duplicates()
        more = f" and {len(names) - SOME} more" if len(names) > SOME else ""
        where = f"{'; '.join(names[:SOME])}{more}" if len(names) < cells else f"all {cells} cells"
        what = f"{len(rows)} mission{'s' * (len(rows) > 1)}"
        every = "" if method in methods else " (it has none)"
        lines.append(f"missing: {method}{every}: {what} in {where}")
    return lines
