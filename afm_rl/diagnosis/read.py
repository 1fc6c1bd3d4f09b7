"""Logs from files: CSV, parquet, and LeRobot's data sets."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet as parquet

from afm_rl.diagnosis.log import FEWEST, Log
from afm_rl.errors import ConfigurationError

PAIRS = ("command", "response")
TRANSITIONS = ("action", "state")
ACTION, STATE, EPISODE = "action", "observation.state", "episode_index"
LOST = 0.5  # share of the rows that may be dropped because a number is missing
INFO = "meta/info.json"
SHOWN = 8  # columns that a message names


@dataclass(frozen=True)
class Columns:
    """The columns of a file, as arrays.

    Args:
        names: of the actuators, or of the columns of each array.
        first: commands or actions, ``(N, A)``.
        second: responses or states, ``(N, S)``.
        t: times (s), ``(N,)``, or None.
        episode: numbers of episodes, ``(N,)``, or None.
        frame: time between command and response of a healthy robot (s).
        notes: what a reader must know.
    """

    names: tuple[Sequence[str], Sequence[str]]
    first: np.ndarray
    second: np.ndarray
    t: np.ndarray | None
    episode: np.ndarray | None
    frame: float = 0.0
    notes: tuple[str, ...] = ()


def read_log(path: str | Path) -> Log:
    """Read what a robot logged.

    * a CSV or parquet file with columns ``command.NAME`` and ``response.NAME``, optionally ``t``
      (s) and ``episode_index``,
    * a folder of LeRobot's: ``meta/info.json``, and parquet files ``data/chunk-*/*.parquet`` with
      the lists ``action`` and ``observation.state``. There a state is read before the action is
      sent, so that a healthy robot is late by one frame.

    Rows in which a number is missing are dropped, with a note.

    Raises:
        ConfigurationError: if the file cannot be used; says what was expected.
    """
    found = read_columns(Path(path), PAIRS)
    commands, responses = found.names
    if sorted(commands) != sorted(responses):
        alone = sorted(set(commands) ^ set(responses))
        raise ConfigurationError(
            f"{path}: {', '.join(alone[:SHOWN])}: expected a command and a response of each "
            "actuator, under the same name"
        )
    order = [list(responses).index(name) for name in commands]
    try:
        return Log(
            names=tuple(commands),
            command=found.first,
            response=found.second[:, order],
            t=found.t,
            episode=found.episode,
            usual_delay=found.frame,
            notes=found.notes,
        )
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {str(error).removeprefix('log: ')}") from error


def read_columns(path: Path, kinds: tuple[str, str]) -> Columns:
    """Read two groups of columns, ``command.*`` and ``response.*`` or ``action.*`` and ``state.*``.

    Raises:
        ConfigurationError: if the file cannot be used.
    """
    if path.is_dir():
        return _lerobot(path)
    if not path.exists():
        raise ConfigurationError(
            f"{path}: no such file; expected a CSV or parquet file, or a folder of LeRobot's"
        )
    if path.suffix.lower() == ".csv":
        table = _read_csv(path)
    elif path.suffix.lower() in (".parquet", ".pq"):
        table = _read_parquet(path).to_pandas()
    else:
        raise ConfigurationError(
            f"{path}: expected a file .csv or .parquet, or a folder of LeRobot's; export the log "
            "as one of these"
        )
    columns = [[c for c in table if str(c).startswith(f"{kind}.")] for kind in kinds]
    if not all(columns):
        raise ConfigurationError(
            f"{path}: columns {', '.join(map(str, list(table)[:SHOWN])) or 'none'}: expected "
            f"{kinds[0]}.NAME and {kinds[1]}.NAME; rename them"
        )
    every = [*columns[0], *columns[1], *(c for c in ("t", EPISODE) if c in table)]
    numbers = {name: _numbers(path, name, table[name]) for name in every}
    first, second = (np.column_stack([numbers[c] for c in group]) for group in columns)
    names = tuple([c.partition(".")[2] for c in group] for group in columns)
    episode = numbers.get(EPISODE)
    return _complete(path, names, first, second, numbers.get("t"), episode)


def _complete(
    path: Path,
    names: Any,
    first: np.ndarray,
    second: np.ndarray,
    t: np.ndarray | None,
    episode: np.ndarray | None,
    frame: float = 0.0,
) -> Columns:
    """Return the rows in which nothing is missing."""
    for group, values in zip(names, (first, second), strict=True):
        for name, column in zip(group, values.T, strict=True):
            if len(column) and not np.isfinite(column).any():
                raise ConfigurationError(
                    f"{path}: {name}: no number in {len(column)} rows; log it, or leave its "
                    "columns out"
                )
    sound = np.isfinite(first).all(1) & np.isfinite(second).all(1)
    for column in (t, episode):
        if column is not None:
            sound &= np.isfinite(column)
    lost = int((~sound).sum())
    if lost > LOST * len(sound) or len(sound) - lost < FEWEST:
        missing = f", {lost} of them with missing numbers" if lost else ""
        raise ConfigurationError(
            f"{path}: {len(sound)} rows{missing}: expected at least {FEWEST} complete ones, and "
            "half of all; log for a longer time"
        )
    notes: tuple[str, ...] = ()
    if lost:
        notes = (f"{lost} of {len(sound)} rows were dropped: numbers are missing",)
    rows = np.flatnonzero(sound)
    if t is None:
        notes += ("no column t: times are in rows",)
    time = rows.astype(float) if t is None else t[rows]
    border = np.zeros(len(rows), dtype=int)
    if episode is not None:
        border = np.cumsum(np.diff(episode[rows], prepend=episode[rows[0]]) != 0)
    back = np.flatnonzero((np.diff(time) <= 0) & (np.diff(border) == 0))
    if len(back):
        row = int(rows[back[0] + 1])
        raise ConfigurationError(
            f"{path}: t goes from {time[back[0]]:.6g} to {time[back[0] + 1]:.6g} s at row {row}: "
            f"expected ascending times; sort the rows, or number episodes in a column {EPISODE}"
        )
    return Columns(names, first[rows], second[rows], time, border, frame, notes)


def _numbers(path: Path, name: str, column: pd.Series) -> np.ndarray:
    """Return a column as numbers, NaN where a cell is empty.

    Raises:
        ConfigurationError: for text, with its row.
    """
    numbers = pd.to_numeric(column, errors="coerce")
    text = numbers.isna() & column.notna()
    if text.any():
        row = int(np.flatnonzero(text)[0])
        raise ConfigurationError(
            f"{path}: {name}: {column.iloc[row]!r:.40} in row {row}: expected a number"
        )
    return numbers.to_numpy(dtype=float)


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path, skipinitialspace=True, low_memory=False)
    except pd.errors.EmptyDataError:
        raise ConfigurationError(f"{path}: empty; expected a head line and rows") from None
    except (pd.errors.ParserError, UnicodeDecodeError, ValueError) as error:
        raise ConfigurationError(f"{path}: no CSV file: {error}") from error
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from error


def _read_parquet(path: Path, columns: Sequence[str] | None = None) -> pyarrow.Table:
    try:
        return parquet.read_table(path, columns=columns)
    except (pyarrow.ArrowException, ValueError) as error:
        raise ConfigurationError(f"{path}: no parquet file: {error}") from error
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror or error}") from error


def _lerobot(folder: Path) -> Columns:
    """Read a data set of LeRobot's, versions 2 and 3."""
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
        features, fps = info["features"], float(info["fps"])
        names = tuple(_feature_names(features[name]) for name in (ACTION, STATE))
    except OSError as error:
        raise ConfigurationError(
            f"{folder}: {INFO}: {error.strerror}; expected a file, or a folder of LeRobot's"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigurationError(
            f"{folder / INFO}: damaged: {error!r}; expected fps, and features {ACTION} and {STATE} "
            "with names"
        ) from error
    if not fps > 0:
        raise ConfigurationError(f"{folder / INFO}: fps={fps}: expected a rate above 0")
    files = sorted(folder.glob("data/chunk-*/*.parquet"))
    if not files:
        raise ConfigurationError(f"{folder}: no data/chunk-*/*.parquet: expected at least one file")
    wanted, parts = (ACTION, STATE, EPISODE, "timestamp", "frame_index"), []
    for file in files:
        there = set(_schema(file))
        absent = {ACTION, STATE, EPISODE} - there
        if absent:
            raise ConfigurationError(f"{file}: no column {', '.join(sorted(absent))}")
        parts.append(_read_parquet(file, [name for name in wanted if name in there]))
    arrays = []
    for kind, group in zip((ACTION, STATE), names, strict=True):
        rows = [_lists(file, part[kind]) for file, part in zip(files, parts, strict=True)]
        if any(values.shape[1] != len(group) for values in rows):
            raise ConfigurationError(
                f"{folder}: {kind}: {rows[0].shape[1]} numbers per row, but {len(group)} names in "
                f"{INFO}"
            )
        arrays.append(np.concatenate(rows))
    episode = np.concatenate([part[EPISODE].to_numpy() for part in parts])
    begin = np.flatnonzero(np.diff(episode, prepend=episode[:1] - 1))
    frame = np.arange(len(episode)) - np.repeat(begin, np.diff(np.append(begin, len(episode))))
    t = frame / fps
    if all("timestamp" in part.column_names for part in parts):
        t = np.concatenate([part["timestamp"].to_numpy() for part in parts]).astype(float)
        close = np.abs(t - frame / fps) < 0.02 / fps
        t = np.where(close, frame / fps, t)  # single precision
    first, second = arrays
    return _complete(folder, names, first, second, t, episode.astype(float), 1 / fps)


def _feature_names(feature: Any) -> list[str]:
    """Return the names of a feature: a list, one under a heading, or places by names."""
    names = feature.get("names")
    if isinstance(names, dict) and all(isinstance(place, int) for place in names.values()):
        names = sorted(names, key=names.__getitem__)
    elif isinstance(names, dict):
        (names,) = names.values()
    if not names:
        return [str(k) for k in range(feature["shape"][0])]
    return [str(name) for name in names]


def _schema(file: Path) -> list[str]:
    try:
        return parquet.read_schema(file).names
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise ConfigurationError(f"{file}: no parquet file: {error}") from error


def _lists(file: Path, column: pyarrow.ChunkedArray) -> np.ndarray:
    """Return a column of lists as an array ``(N, A)``."""
    try:
        joined = column.combine_chunks()
        flat = joined.flatten().to_numpy(zero_copy_only=False).astype(float)
        return flat.reshape(len(column), -1)
    except (ValueError, AttributeError, TypeError) as error:
        raise ConfigurationError(
            f"{file}: expected lists of numbers of one length under {ACTION} and {STATE}"
        ) from error
