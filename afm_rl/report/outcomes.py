"""How missions of different methods compare."""

from __future__ import annotations

import numpy as np
import pandas as pd


def add_outcomes(missions: pd.DataFrame) -> pd.DataFrame:
    """Return the missions with what comparisons need.

    New columns: ``cost``, the number of the last step, but for a mission that was given up the
    most that any given-up mission of its cell was allowed (the budget); ``score``, whole numbers
    that order all missions: higher success first, then, among equals, lower cost.

    Args:
        missions: one row per mission, with ``cell``.

    >>> rows = {"cell": ["a"] * 3, "steps": [90, 80, 99], "success_rate": [1.0, 1.0, 0.5]}
    >>> missions = add_outcomes(pd.DataFrame(rows | {"finished": [True, True, False]}))
    >>> missions["cost"].tolist(), missions["score"].tolist()
    ([90, 80, 99], [1, 2, 0])
    """
    given_up = missions["steps"].where(~missions["finished"])
    budget = given_up.groupby(missions["cell"]).transform("max")
    cost = np.where(missions["finished"], missions["steps"], budget).astype(int)
    order = missions.assign(cost=cost, gain=-cost)
    score = order.groupby(["success_rate", "gain"]).ngroup()
    return order.drop(columns="gain").assign(score=score)


def budget_notes(missions: pd.DataFrame) -> list[str]:
    """Say where missions of one cell were given up after different numbers of steps."""
    given_up = missions[~missions["finished"]]
    budgets = given_up.groupby("cell", sort=False)["steps"].agg(["min", "max"])
    apart = budgets[budgets["min"] < budgets["max"]]
    return [
        f"{cell}: missions were given up after {row['min']} to {row['max']} steps; "
        f"in comparisons all of them count as {row['max']}."
        for cell, row in apart.iterrows()
    ]


def pair(missions: pd.DataFrame, method: str, other: str) -> pd.DataFrame:
    """Return the missions that two methods share: same cell, same seed.

    Returns:
        One row per pair: ``cell``, ``seed``, and the columns of both, the other method's with
        the ending ``_other``.
    """
    mine, its = (missions[missions["method"] == name] for name in (method, other))
    return mine.merge(its, on=["cell", "seed"], suffixes=("", "_other"))
