"""The two data frames every report is made from: missions and steps."""

from __future__ import annotations

from collections.abc import Container, Iterable

import pandas as pd

from afm_rl.errors import ConfigurationError
from afm_rl.storage.measures import Measures

STEPS = ["mission", "t", "error", "misaligned", "loss", "regime_active"]


def check_frames(missions: pd.DataFrame, steps: pd.DataFrame, measures: Measures) -> None:
    """Check what reports rely on.

    Raises:
        ConfigurationError: if there is no mission, a column is missing, a mission's number
            occurs twice, or a mission has no steps.
    """
    first = ["method", "track", "seed"]
    wanted = list(dict.fromkeys([*first, *measures.columns, "steps", outcome(missions), "mission"]))
    for name, frame, columns in (("missions", missions, wanted), ("steps", steps, STEPS)):
        missing = [column for column in columns if column not in frame]
        if missing:
            raise ConfigurationError(f"{name}: columns {', '.join(missing)} are missing")
    number = missions["mission"]
    if number.empty:
        raise ConfigurationError("missions: no rows; expected at least one mission")
    if not number.is_unique:
        raise ConfigurationError(
            f"missions: mission {number[number.duplicated()].iloc[0]} occurs twice; number the "
            "missions of all methods through before joining their frames"
        )
    without = number[~number.isin(steps["mission"].unique())]
    if len(without):
        raise ConfigurationError(f"steps: no rows for mission {without.iloc[0]}")


def outcome(columns: Container[str]) -> str:
    """Return the name of the column that says how missions ended.

    ``finished`` where there is a goal to reach; otherwise ``terminated``, whether the episode
    ended before its time.

    >>> outcome(["steps", "terminated"])
    'terminated'
    """
    return "terminated" if "terminated" in columns else "finished"


def regime_names(missions: pd.DataFrame) -> list[str]:
    """Return the names of the regime's parameters: the columns between track and seed.

    >>> regime_names(pd.DataFrame(columns=["method", "track", "v_gain", "seed", "steps"]))
    ['v_gain']
    """
    names = list(missions.columns)
    return names[names.index("track") + 1 : names.index("seed")]


def cell_names(missions: pd.DataFrame) -> pd.Series:
    """Return each mission's cell: its track and regime, in words.

    The regime is what the column ``regime`` calls it; without one, its parameters, but for gains
    of 1.

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
    regimes = pd.Series("", index=missions.index)
    for name in regime_names(missions):
        regimes += missions[name].map(f", {name} = {{:g}}".format)
    regimes = regimes.str.replace(r", \w*gain = 1(?=,|$)", "", regex=True)
    return (tracks + regimes.where(regimes != "", ", nominal")).rename("cell")


def first_missions(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one mission per method and cell, the first, with a column ``cell``."""
    named = missions if "cell" in missions else missions.assign(cell=cell_names(missions))
    return named.drop_duplicates(["method", "cell"])


def left_out(missions: pd.DataFrame, shown: pd.DataFrame) -> str:
    """Say how many missions a figure does not show; nothing if it shows all."""
    missing = len(missions) - len(shown)
    return f"{missing} of {len(missions)} missions not shown" if missing else ""


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
