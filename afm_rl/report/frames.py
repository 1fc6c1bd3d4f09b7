"""The two data frames every report is made from: missions and steps."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from afm_rl.errors import ConfigurationError
from afm_rl.report.kinds import kind_of

FRONT = ["method", "track"]
STEPS = ["mission", "t", "error", "misaligned", "loss", "regime_active"]


def check_frames(missions: pd.DataFrame, steps: pd.DataFrame) -> None:
    """Check what reports rely on.

    Raises:
        ConfigurationError: if there is no mission, a column is missing, a mission's number
            occurs twice, or a mission has no steps.
    """
    kind = kind_of(missions)
    wanted_of_missions, wanted_of_steps = [*FRONT, *kind.missions], [*STEPS, *kind.steps]
    for name, frame, wanted in (
        ("missions", missions, wanted_of_missions),
        ("steps", steps, wanted_of_steps),
    ):
        missing = [column for column in wanted if column not in frame]
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


def regime_names(missions: pd.DataFrame) -> list[str]:
    """Return the names of the regime's parameters: the columns between track and seed.

    >>> regime_names(pd.DataFrame(columns=["method", "track", "v_gain", "seed", "steps"]))
    ['v_gain']
    """
    names = list(missions.columns)
    return names[names.index("track") + 1 : names.index("seed")]


def order_columns(missions: pd.DataFrame) -> pd.DataFrame:
    """Return the missions with their columns in the order of the files; others come last."""
    known = [*FRONT, *regime_names(missions), *kind_of(missions).missions]
    return missions[[*known, *(name for name in missions if name not in known)]]


def cell_names(missions: pd.DataFrame) -> pd.Series:
    """Return each mission's cell: its track and regime, in words.

    The regime is what the column ``regime`` calls it; without one, its parameters.

    >>> row = {"method": "physics", "track": "oval", "v_gain": -1.0, "seed": 0}
    >>> cell_names(pd.DataFrame([row])).tolist()
    ['oval, v_gain = -1']
    >>> cell_names(pd.DataFrame([row | {"regime": "slip"}])).tolist()
    ['oval, slip']
    """
    cells = missions["track"].astype(str)
    if "regime" in missions:
        # A family draws its parameters anew for each seed: only its name is the same.
        return (cells + ", " + missions["regime"].astype(str)).rename("cell")
    for name in regime_names(missions):
        cells = cells + missions[name].map(f", {name} = {{:g}}".format)
    return cells.rename("cell")


def short_cell_names(missions: pd.DataFrame) -> pd.Series:
    """Return each mission's cell, gains of 1 not named, as the column ``regime`` has it.

    So results with that column and results without it can be joined.

    >>> row = {"method": "physics", "track": "oval", "v_gain": 1.0, "seed": 0}
    >>> short_cell_names(pd.DataFrame([row, row | {"v_gain": -1.0}])).tolist()
    ['oval, nominal', 'oval, v_gain = -1']
    """
    names = cell_names(missions)
    if "regime" in missions:
        return names
    short = names.str.replace(r", \w*gain = 1(?=,|$)", "", regex=True)
    return short.where(short != missions["track"].astype(str), short + ", nominal")


def first_missions(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one mission per method and cell, the first, with a column ``cell``."""
    named = missions.assign(cell=cell_names(missions))
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
