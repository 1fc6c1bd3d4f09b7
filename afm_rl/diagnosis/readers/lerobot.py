"""Data sets of LeRobot, versions 2 and 3."""

from __future__ import annotations

import json
import stat
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from afm_rl.diagnosis.readers.choose import ACTIONS, STATES
from afm_rl.diagnosis.readers.parquet import columns_of, source_of, width_of
from afm_rl.diagnosis.readers.source import Series, Source, check_regular
from afm_rl.errors import ConfigurationError, printable

INFO = "meta/info.json"
FASTEST, SLOWEST = 1e6, 1e-3  # rates (1/s) that a robot may have
TIME, EPISODE = "timestamp", "episode_index"


def open_lerobot(folder: Path) -> Source:
    """Return actions and states of a data set: ``action.NAME``, ``observation.state.NAME``.

    A state is read before the action is sent, so that a healthy robot is late by one frame.

    Raises:
        ConfigurationError: if the folder cannot be used.
    """
    features, fps = _info(check_regular(folder / INFO))
    files, notes = _files(folder)
    for file in files:
        if EPISODE not in columns_of(file):
            raise ConfigurationError(f"{file}: no column {EPISODE}")
    columns = columns_of(files[0])
    names: dict[str, tuple[str, int | None]] = {}
    for heads in (ACTIONS, STATES):
        head = next((h for h in heads if h in features), None)
        if head is None:
            raise ConfigurationError(f"{INFO}: no feature {' or '.join(heads)}")
        if head not in columns:
            raise ConfigurationError(f"{files[0]}: no column {head}")
        names |= _named(files[0], head, features[head])
    every = all(TIME in columns_of(file) for file in files)
    names |= {name: (name, None) for name in (EPISODE, *((TIME,) if every else ()))}
    source = source_of(folder, files, names, TIME, EPISODE, 1 / fps, notes)

    def read(wanted: Sequence[str]) -> dict[str, Series]:
        found = dict(source.read([name for name in wanted if name in names]))
        row = next(iter(found.values())).row
        t = found[TIME].values if every else np.asarray(row) / fps
        whole = np.round(t * fps) / fps  # stored in single precision, a little off
        t = np.where(np.abs(t - whole) < 0.02 / fps, whole, t)
        return found | {TIME: Series(t, row=row)}

    return replace(source, read=read, time=TIME)


def _info(file: Path) -> tuple[dict[str, Any], float]:
    """Return the features of a data set, and its rate (1/s)."""
    try:
        info = json.loads(file.read_text(encoding="utf-8"))
        features, fps = info["features"], float(info["fps"])
        if not isinstance(features, dict):
            raise TypeError("features")
    except (ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
        reason = printable(repr(error), 60)
        raise ConfigurationError(
            f"{INFO}: damaged: {reason}; expected fps, and features {ACTIONS[0]} and {STATES[0]}"
        ) from error
    if not SLOWEST <= fps <= FASTEST:
        raise ConfigurationError(
            f"{INFO}: fps={fps}: expected a rate between {SLOWEST:g} and {FASTEST:g}"
        )
    return features, fps


def _files(folder: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return the parquet files of a data set, and a note of what was skipped."""
    found = sorted(folder.glob("data/chunk-*/*.parquet"))
    regular = [file for file in found if _is_regular(file)]
    if not regular:
        raise ConfigurationError("no data/chunk-*/*.parquet: expected at least one file")
    skipped = [printable(file.name) for file in found if file not in set(regular)]
    if not skipped:
        return regular, ()
    return regular, (f"skipped, no regular file: {', '.join(skipped[:8])}",)


def _is_regular(file: Path) -> bool:
    try:
        return stat.S_ISREG(file.stat().st_mode)
    except OSError:
        return False


def _named(file: Path, head: str, feature: Any) -> dict[str, tuple[str, int | None]]:
    """Return the names of a feature's numbers: as given, or their places."""
    width = width_of(file, head)  # one number is no list
    places: list[int | None] = [None] if width is None else list(range(width))
    given = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(given, dict) and all(type(place) is int for place in given.values()):
        given = sorted(given, key=given.__getitem__)
    try:
        names = list(_flat(given))
    except RecursionError as error:
        raise ConfigurationError(f"{INFO}: {head}: names nested too deeply") from error
    if names and len(names) != len(places):
        raise ConfigurationError(
            f"{head}: {len(places)} numbers per row, but {len(names)} names in {INFO}"
        )
    names = names or [str(place) for place in range(len(places))]
    if len(set(names)) < len(places):
        raise ConfigurationError(f"{INFO}: {head}: two of the {len(places)} names are the same")
    return {f"{head}.{n}": (head, place) for n, place in zip(names, places, strict=True)}


def _flat(names: Any) -> Iterator[str]:
    """Yield the names of lists in lists, and of lists under headings.

    >>> list(_flat({"arm": [["a", "b"]], "hand": ["c"]})), list(_flat(None))
    (['a', 'b', 'c'], [])
    """
    if isinstance(names, dict):
        names = list(names.values())
    if isinstance(names, list):
        for part in names:
            yield from _flat(part)
    elif names is not None:
        yield str(names)
