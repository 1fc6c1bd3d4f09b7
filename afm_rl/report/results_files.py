"""Tables of results on disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet as parquet

from afm_rl.errors import ConfigurationError
from afm_rl.report.kinds import LAPS, kind_of

WORDS = ["method", "track", "regime"]  # text, whatever they look like
NO_NUMBERS = ["seconds", "finished", "mission"]  # not needed, or no numbers to check


def read_table(path: Path, columns: Sequence[str]) -> pd.DataFrame:
    """Return a CSV file that has at least these columns.

    Raises:
        ConfigurationError: if it cannot be read, or a column is missing.
    """
    try:
        table = pd.read_csv(path, dtype=dict.fromkeys(WORDS, str))
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from error
    except (ValueError, pd.errors.ParserError) as error:
        raise ConfigurationError(f"{path}: no table of values: {error}") from error
    _check_columns(path, table, columns)
    return table


def _check_columns(path: Path, table: pd.DataFrame, columns: Sequence[str]) -> None:
    missing = [column for column in columns if column not in table]
    if missing:
        raise ConfigurationError(f"{path}: columns {', '.join(missing)} are missing")


def read_missions(path: Path) -> pd.DataFrame:
    """Return a table of missions, checked.

    Raises:
        ConfigurationError: if it cannot be read, a column is missing, or a value cannot be.
    """
    missions = read_table(path, [])
    kind = kind_of(missions)
    numbers = [name for name in kind.missions if name not in NO_NUMBERS]
    _check_columns(path, missions, ["method", "track", *numbers, "finished", "mission"])
    for name in numbers:
        numeric = pd.api.types.is_numeric_dtype(missions[name])
        if len(missions) and not (numeric and np.isfinite(missions[name]).all()):
            raise ConfigurationError(f"{path}: {name}: expected a finite number in each row")
    if len(missions) and missions["finished"].dtype != bool:
        raise ConfigurationError(f"{path}: finished: expected True or False in each row")
    if kind is not LAPS:
        return missions
    # Single precision as text has seven digits: 6/34 is the same number in all files again.
    return missions.assign(success_rate=missions["success_rate"].astype(float).round(6))


def step_columns(path: Path) -> list[str]:
    """Return the names of the columns of a file of steps.

    Raises:
        ConfigurationError: if it cannot be read.
    """
    try:
        return parquet.read_schema(path).names
    except (OSError, pyarrow.ArrowException) as error:
        raise ConfigurationError(f"{path}: damaged, or no Parquet file") from error


def read_steps(
    files: Sequence[Path], missions: pd.DataFrame, columns: Sequence[str]
) -> pd.DataFrame:
    """Return the steps of some missions, under the numbers that ``missions`` gives them.

    Only the missions and columns asked for stay in memory.

    Args:
        files: the files of steps.
        missions: rows of :attr:`~afm_rl.report.collect.Collection.missions`.
        columns: what to read beside ``mission`` and ``t``; a column that a file lacks is NaN.

    Returns:
        One row per mission and step, in their order.

    Raises:
        ConfigurationError: if a file cannot be read.
    """
    parts = []
    for place, rows in missions[missions["file"] >= 0].groupby("file"):
        path, new = files[place], rows.set_index("own")["mission"]
        wanted = [name for name in ["mission", "t", *columns] if name in step_columns(path)]
        part = pd.read_parquet(path, columns=wanted, filters=[("mission", "in", list(new.index))])
        parts.append(part.assign(mission=part["mission"].map(new)))
    joined = pd.concat(parts) if parts else pd.DataFrame()
    return joined.reindex(columns=["mission", "t", *columns]).sort_values(
        ["mission", "t"], ignore_index=True
    )
