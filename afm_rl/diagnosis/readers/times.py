"""Times as people log them: in some unit, since 1970 or since some begin, or as dates."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import pandas as pd

from afm_rl.errors import ConfigurationError, printable

UNIT = r"s|sec\w*|[mun]s\w*|(?:milli|micro|nano)s\w*"
TIME = re.compile(
    rf"%?(t|time|timestamp|datetime|stamp)(?:[ _]?[ _([]({UNIT})[)\]]?)?", re.IGNORECASE
)
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
EPOCH = (9e8, 4.2e9)  # s since 1970: from 1998 to 2103


def time_among(names: Sequence[str]) -> str | None:
    """Return the name of the time, ``t`` before others; None if there is none.

    >>> time_among(["command.a", "timestamp_ms"]), time_among(["Time", "t"]), time_among(["torque"])
    ('timestamp_ms', 't', None)
    """
    order = ("t", "time", "timestamp", "datetime", "stamp")
    ranks = {n: order.index(m[1].lower()) for n in names if (m := TIME.fullmatch(n))}
    return min(ranks, key=ranks.__getitem__, default=None)


def numbers_of(name: str, column: pd.Series) -> np.ndarray:
    """Return dates as ISO 8601 writes them, or dates of a table, as seconds since 1970.

    Raises:
        ConfigurationError: naming the first cell that is something else.

    >>> numbers_of("time", pd.Series(["1970-01-01T00:00:01.5Z", "1970-01-01 01:00:02+01:00", None]))
    array([1.5, 2. , nan])
    """
    dates = pd.to_datetime(column, format="ISO8601", utc=True, errors="coerce")
    odd = np.flatnonzero(dates.isna() & column.notna())
    if len(odd):
        cell = printable(repr(column.iloc[odd[0]]), 40)
        raise ConfigurationError(
            f"{printable(name)}: {cell} in row {odd[0]}: expected a number, as of seconds, or a "
            "date of ISO 8601, as in 2024-05-01T12:00:00.25Z"
        )
    return (dates - pd.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy()


def in_seconds(
    name: str, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Return times in s, those since 1970 from the first row on; and what was assumed.

    A unit in the name counts, and ``t`` is in s. Else whole numbers may be s, ms, us or ns: as a
    date of this century says, or as steps of at most half a second do. Where several rows have the
    same time, rows are taken as even; between two pauses is a stretch of them.

    Returns:
        times ``(N,)``; the number of each row's stretch ``(N,)``, None without pauses; notes.

    >>> in_seconds("time", np.array([1714564800020, 1714564800040]))
    (array([0.  , 0.02]), None, ('time: read as ms',))
    """
    match, known = TIME.fullmatch(name), values[np.isfinite(values)]
    if match is None or not len(known) or name == "t":
        return values, None, ()
    word, notes = (match[2] or "").lower(), []
    unit = {"s": "s", "mil": "ms", "mic": "us", "n": "ns", "m": "ms", "u": "us"}.get(
        word[:3] if word[:2] == "mi" else word[:1]
    )
    if unit is None:
        unit = _unit_of(known)
        notes += [f"{printable(name)}: read as {unit}"] * (unit != "s")
    since = known[0] if EPOCH[0] < known[0] * UNITS[unit] < EPOCH[1] else 0.0
    seconds, steps, stretch = (values - since) * UNITS[unit], np.diff(known), None
    coarse = len(steps) and (steps >= 0).all() and (steps == 0).mean() > 0.2
    if coarse and len(known) == len(values):
        seconds, stretch = _even(seconds)
        notes.append(f"{printable(name)} is coarse, several rows each: rows are taken as even")
        if stretch[-1]:
            count = f"{stretch[-1]} pause{'s' * bool(stretch[-1] > 1)}"
            notes.append(f"{printable(name)} has {count}: a new stretch of rows begins after each")
    return seconds, stretch if stretch is not None and stretch[-1] else None, tuple(notes)


def _even(seconds: np.ndarray, pause: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Return even times, and the number of each row's stretch, of times that several rows share.

    A stretch ends where the time continues by more than three of its usual steps.

    >>> _even(np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 9.0, 9.0]))
    (array([0. , 0.5, 1. , 1.5, 2. , 2.5, 9. , 9.5]), array([0, 0, 0, 0, 0, 0, 1, 1]))
    """
    steps = np.diff(seconds)
    if not steps.any():
        return seconds, np.zeros(len(seconds), dtype=int)
    usual = float(np.median(steps[steps > 0]))
    stretch = np.concatenate([[0], np.cumsum(steps > pause * usual)])
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    last = np.append(first[1:], len(seconds)) - 1
    step = float((seconds[last] - seconds[first] + usual).sum()) / len(seconds)
    begin = seconds[first][stretch]
    return begin + step * (np.arange(len(seconds)) - first[stretch]), stretch


def _unit_of(known: np.ndarray, longest: float = 0.5) -> str:
    steps = np.diff(known)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for unit, size in UNITS.items():
        if EPOCH[0] < known[0] * size < EPOCH[1] and step * size < 10:
            return unit
    if step < 2 or (known != np.round(known)).any():
        return "s"
    return next((unit for unit, size in UNITS.items() if step * size <= longest), "ns")
