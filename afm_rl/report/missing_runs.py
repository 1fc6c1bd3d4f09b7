"""Missions that were to be run and have no results."""

from __future__ import annotations

from textwrap import shorten

import pandas as pd

from afm_rl.report.collect import KEY
from afm_rl.report.table import Table

NOTE = (
    "Every method is expected to have every cell and seed that any method has, and all that was to "
    "be run."
)
WIDE = 60  # letters of a list in a line of the terminal


def find_missing(missions: pd.DataFrame, plan: pd.DataFrame) -> pd.DataFrame:
    """Return what is missing, one row per ``method``, ``cell`` and ``seed``.

    Args:
        missions: what there is, with ``cell``.
        plan: what was to be run, with the same three columns.

    >>> there = pd.DataFrame({"method": ["a", "b", "b"], "cell": ["oval"] * 3, "seed": [0, 0, 1]})
    >>> find_missing(there, there[:0]).to_dict("records")
    [{'method': 'a', 'cell': 'oval', 'seed': 1}]
    """
    wanted = pd.concat([missions[KEY], plan[KEY]]) if len(plan) else missions[KEY]
    places = wanted[["cell", "seed"]].drop_duplicates()
    every = wanted[["method"]].drop_duplicates().merge(places, how="cross")
    both = every.merge(missions[KEY], how="left", on=KEY, indicator=True)
    return both.loc[both["_merge"] == "left_only", KEY].reset_index(drop=True)


def missing_table(missing: pd.DataFrame, cells: int) -> Table:
    """Return the table of what is missing, one row per method and set of seeds.

    Args:
        missing: from :func:`find_missing`.
        cells: how many there are in all.
    """
    rows = []
    seeds = missing.groupby(["method", "cell"], sort=False)["seed"].agg(tuple).reset_index()
    for (method, numbers), group in seeds.groupby(["method", "seed"], sort=False):
        rows.append(
            {
                "method": method,
                "missions": str(len(group) * len(numbers)),
                "seeds": ", ".join(map(str, numbers)),
                "cells": f"all {cells}" if len(group) == cells else "; ".join(group["cell"]),
            }
        )
    align = r"lrlp{0.6\textwidth}"
    return Table("missing", "Missing missions", NOTE, missing, pd.DataFrame(rows), align=align)


def missing_lines(table: Table) -> list[str]:
    """Say in one line per row of :func:`missing_table` what is missing.

    >>> missing = pd.DataFrame({"method": ["a", "a"], "cell": ["oval", "ring"], "seed": [1, 1]})
    >>> missing_lines(missing_table(missing, cells=3))
    ['missing: a: 2 missions, seeds 1, cells oval; ring']
    """
    return [
        f"missing: {row['method']}: {row['missions']} missions, "
        f"seeds {shorten(row['seeds'], WIDE)}, cells {shorten(row['cells'], WIDE)}"
        for row in table.shown.to_dict("records")
    ]
