"""Words of the tables of missions and steps: cells, outcomes, actions."""

from __future__ import annotations

from collections.abc import Container, Iterable

import pandas as pd


def outcome(columns: Container[str]) -> str:
    """Return the name of the column that says how missions ended.

    ``finished`` where there is a goal to reach; otherwise ``terminated``, whether the episode
    ended before its time.

    >>> outcome(["steps", "terminated"])
    'terminated'
    """
    return "terminated" if "terminated" in columns else "finished"


def cell_names(missions: pd.DataFrame) -> pd.Series:
    """Return each mission's cell: its track and regime, in words.

    The regime is what the column ``regime`` calls it; without one, its parameters, the columns
    between track and seed, but for gains of 1.

    >>> row = {"method": "physics", "track": "oval", "v_gain": 1.0, "seed": 0}
    >>> cell_names(pd.DataFrame([row, row | {"v_gain": -1.0}])).tolist()
    ['oval, nominal', 'oval, v_gain = -1']
    >>> cell_names(pd.DataFrame([row | {"regime": "slip"}])).tolist()
    ['oval, slip']
    """
    tracks = missions["track"].astype(str)
    if "regime" in missions:
        # A family draws its parameters anew for each seed: only its name is the same.
        return (tracks + ", " + missions["regime"].astype(str)).rename("cell")
    regimes, names = pd.Series("", index=missions.index), list(missions)
    for name in names[names.index("track") + 1 : names.index("seed")]:
        regimes += missions[name].map(f", {name} = {{:g}}".format)
    regimes = regimes.str.replace(r", \w*gain = 1(?=,|$)", "", regex=True)
    return (tracks + regimes.where(regimes != "", ", nominal")).rename("cell")


def with_cells(missions: pd.DataFrame) -> pd.DataFrame:
    """Return the missions with a column ``cell``."""
    return missions if "cell" in missions else missions.assign(cell=cell_names(missions))


def first_missions(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one mission per method and cell, the first, with a column ``cell``."""
    return with_cells(missions).drop_duplicates(["method", "cell"])


def steps_of(steps: pd.DataFrame, missions: Iterable[int]) -> dict[int, pd.DataFrame]:
    """Return the steps of some missions, by mission.

    >>> steps = pd.DataFrame({"mission": [0, 0, 1, 2], "t": [0, 1, 0, 0]})
    >>> {number: len(rows) for number, rows in steps_of(steps, [0, 2]).items()}
    {0: 2, 2: 1}
    """
    chosen = steps[steps["mission"].isin(list(missions))]
    return dict(iter(chosen.groupby("mission", sort=False)))


def action_names(steps: pd.DataFrame) -> list[str]:
    """Return the names of the action's components.

    >>> action_names(pd.DataFrame(columns=["x", "planned_v", "executed_v"]))
    ['v']
    """
    return [name.removeprefix("planned_") for name in steps if name.startswith("planned_")]
