"""A file or folder becomes a log."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from afm_rl.diagnosis.log import FEWEST, Log
from afm_rl.diagnosis.readers import messages, parquet, tables
from afm_rl.diagnosis.readers.angles import with_angles
from afm_rl.diagnosis.readers.source import (
    EFFECTIVE,
    MEASURED,
    Columns,
    Series,
    Source,
    check_regular,
    choose,
    thinned_note,
)
from afm_rl.diagnosis.readers.telemetry import frozen_episodes, frozen_rows, listed
from afm_rl.diagnosis.readers.times import in_seconds
from afm_rl.errors import ConfigurationError, printable

PAIRS = ("command", "response")
TRANSITIONS = ("action", "state")
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
LARGEST = 1e30  # squares of larger numbers leave single precision

READERS: dict[str, Callable[[Path], Source]] = {
    ".csv": tables.open_csv,
    ".tsv": tables.open_csv,
    ".parquet": parquet.open_parquet,
    ".pq": parquet.open_parquet,
    ".ulg": messages.open_ulog,
    ".ulog": messages.open_ulog,
    ".mcap": messages.open_mcap,
    ".bag": messages.open_bag,
    ".db3": messages.open_bag,
}
BAG = "metadata.yaml"
EXPECTED = (
    "expected a file .csv, .tsv, .parquet, .ulg, .mcap, .db3 or .bag, or a folder of LeRobot or ROS"
)


def open_source(path: Path) -> Source:
    """Return what there is in a file or folder, and angles that follow from it."""
    return with_angles(_opened(path))


def _opened(path: Path) -> Source:
    if path.is_dir():
        if (path / parquet.INFO).parent.exists():
            return parquet.open_lerobot(path)
        if (path / BAG).exists():
            return messages.open_bag(path)
        raise ConfigurationError(
            f"{path}: a folder without {parquet.INFO} (LeRobot) or {BAG} (ROS); {EXPECTED}"
        )
    if not path.is_symlink() and not path.exists():
        raise ConfigurationError(f"{path}: no such file; {EXPECTED}")
    reader = READERS.get(check_regular(path).suffix.lower())
    if reader is None:
        raise ConfigurationError(f"{path}: {EXPECTED}; export the log as one of these")
    return reader(path)


@contextmanager
def bounded_memory(path: Path, least: int = 1 << 30, ratio: int = 8) -> Iterator[None]:
    """Let messages take no more than 1 GiB and eight times their file, of memory and of the disk.

    What they unpack to is not known before, as it is of tables; where it is more, reading ends in
    an error. The limits are those of the whole process, so this is for commands. Some systems have
    none.
    """
    reader = messages.open_bag if (path / BAG).exists() else READERS.get(path.suffix.lower())
    if reader not in (messages.open_bag, messages.open_mcap, messages.open_ulog):
        yield
        return
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except (ImportError, OSError):
        yield
        return
    parts = (path, *path.glob("*"))
    spare = least + ratio * sum(os.path.getsize(part) for part in parts if os.path.isfile(part))
    limits = {resource.RLIMIT_DATA: used + spare, resource.RLIMIT_FSIZE: spare}
    before = {kind: resource.getrlimit(kind) for kind in limits}
    try:
        for kind, (soft, hard) in before.items():
            bounds = [limits[kind], *(x for x in (soft, hard) if x != resource.RLIM_INFINITY)]
            resource.setrlimit(kind, (min(bounds), hard))
        yield
    finally:
        for kind, both in before.items():
            resource.setrlimit(kind, both)


def read_log(
    path: str | Path,
    command: Sequence[str] = (),
    response: Sequence[str] = (),
    episode: str | None = None,
) -> Log:
    """Read what a robot logged.

    * a CSV or parquet file with columns ``command.NAME`` and ``response.NAME``, optionally ``t``
      (s) and ``episode_index``, or lists ``action`` and ``observation.state``,
    * a folder of LeRobot (versions 2 and 3). There a state is read before the action is sent, so
      that a healthy robot is late by one frame,
    * a ULog of PX4, an MCAP file, a bag of ROS (extra ``logs``): ``command`` and ``response`` name
      their fields. A row is made for each message of the first response; of all others, the last
      message before it counts.

    Rows in which a number is missing are dropped, with a note. Where the number of the episode
    changes, the command before is not known.

    Args:
        path: of the file or folder.
        command: names of fields that are commands, ``FIELD`` or ``NAME=FIELD``; a topic or array
            stands for all its fields.
        response: their responses, in the same order.
        episode: name of the number of the episode, or of the window; ``episode_index`` if None.

    Raises:
        Unchosen: if it is not known what a command is; has a listing of what there is.
        ConfigurationError: if the file cannot be used; says what was expected.
    """
    columns = read_columns(Path(path), PAIRS, command, response, episode)
    with _about(path):
        same = ("t", "episode", "read_from", "notes", "effort", "computed", "doubts")
        return Log(
            names=tuple(printable(name) for name in columns.names[0]),
            command=columns.first,
            response=columns.second,
            usual_delay=columns.frame,
            row=columns.row if columns.read_from > len(columns.first) else None,
            **{name: getattr(columns, name) for name in same},
        )


def read_columns(
    path: Path,
    kinds: tuple[str, str],
    command: Sequence[str] = (),
    response: Sequence[str] = (),
    episode: str | None = None,
) -> Columns:
    """Read groups of columns: ``command.*``, ``response.*`` or ``action.*``, ``state.*``."""
    with _about(path):
        source = open_source(path)
        if episode is not None:
            if episode not in source.names:
                raise ConfigurationError(f"--episode {printable(episode)}: there is no such name")
            source = replace(source, episode=episode)
        wanted, names, notes = choose(source, kinds, command, response, kinds == PAIRS)
        others = [name for name in (source.time, source.episode) if name is not None]
        columns = source.read(list(dict.fromkeys([*wanted[0], *wanted[1], *others])))
        clock = columns[wanted[1][0]].t
        if clock is None:
            columns, filled = _filled(columns, [*wanted[0], *wanted[1]], wanted[1][0])
            notes = (*notes, *filled)
        else:
            columns = {name: _held(series, clock) for name, series in columns.items()}
        for name, series in columns.items():
            if not (np.abs(series.values[np.isfinite(series.values)]) < LARGEST).all():
                row = int(np.flatnonzero(np.abs(np.nan_to_num(series.values)) >= LARGEST)[0])
                raise ConfigurationError(
                    f"{printable(name)}: row {row}: expected numbers below {LARGEST:g}"
                )
        first, second = (np.column_stack([columns[n].values for n in group]) for group in wanted)
        time, assumed = columns[source.time].values if source.time else clock, tuple[str, ...]()
        if source.time and time is not None and not source.frame:
            time, assumed = in_seconds(source.time, time)
            if len(np.unique(time[np.isfinite(time)])) == 1:
                time, assumed = None, (f"{printable(source.time)} never changes",)
        border = columns[source.episode].values if source.episode else None
        leading = columns[wanted[0][0]]
        number = np.arange(len(first)) if leading.row is None else leading.row
        notes = (*source.notes, *thinned_note(number, leading.rows), *assumed, *notes)
        if border is not None and len(number) > number[-1] and _take_turns(border):
            order = np.argsort(border, kind="stable")
            first, second, border = first[order], second[order], border[order]
            time = None if time is None else time[order]
        done = _complete(source, names, first, second, number, time, border, notes)
        computed = all(name.startswith(f"{EFFECTIVE}.") for name in wanted[1])
        doubts = {}
        for name, *pair in zip(names[0], *wanted, strict=False) if kinds == PAIRS else ():
            first_topic, second_topic = (m and m[1] for m in map(MEASURED.fullmatch, pair))
            if source.topics and first_topic and first_topic == second_topic:
                doubts[printable(name)] = (
                    f"{first_topic} measures its command and its response in one message; name "
                    "what was sent as the command"
                )
        return replace(done, effort=_effort(source), computed=computed, doubts=doubts)


def _take_turns(episode: np.ndarray) -> bool:
    """Return whether episodes take turns, as robots do that are logged side by side.

    >>> _take_turns(np.array([0, 1, 0, 1, 0, 1])), _take_turns(np.arange(6))
    (True, False)
    """
    turns = int((np.diff(episode) != 0).sum())
    return turns > len(episode) / 2 and len(np.unique(episode)) <= len(episode) / 2


@contextmanager
def _about(path: str | Path) -> Iterator[None]:
    """Let messages begin with the path."""
    try:
        yield
    except ConfigurationError as error:
        begin, text = (printable(str(x), 4000) for x in (path, error))
        text = text.removeprefix("log: ")
        if not text.startswith(begin):
            error.args = (f"{begin}: {text}",)
        raise
    except RecursionError as error:
        raise ConfigurationError(f"{path}: nested too deeply; expected a log") from error
    except MemoryError as error:
        raise ConfigurationError(f"{path}: not enough memory; log less at a time") from error


def _effort(source: Source, most: int = 16) -> dict[str, np.ndarray]:
    """Return how hard the motors were driven, as far as that was logged in numbers."""
    motors = re.compile(r"(pwm|thrust|throttle|motor|esc)[._]?\d*")
    names = [name for name in source.names if motors.fullmatch(name)][:most]
    try:
        logged = source.read(names) if names else {}
    except ConfigurationError:
        return {}
    finite = {name: series.values[np.isfinite(series.values)] for name, series in logged.items()}
    return {printable(name): values for name, values in finite.items() if len(values)}


def _held(series: Series, clock: np.ndarray) -> Series:
    """Return the newest value at each time of a clock, NaN before the first one."""
    if series.t is None:
        return series
    place = np.searchsorted(series.t, clock, side="right") - 1
    values = np.append(series.values, np.nan)
    return Series(values[place], clock)  # -1, before the first one, is the NaN


def _filled(
    columns: Mapping[str, Series], names: Sequence[str], response: str
) -> tuple[Mapping[str, Series], tuple[str, ...]]:
    """Return the columns of a table with a row per message as a row for each ``response``.

    There no row is complete, and the last number of each column counts.
    """
    sound = {name: np.isfinite(series.values) for name, series in columns.items()}
    known = [sound[name] for name in names]
    if np.logical_and.reduce(known).any() or not all(own.any() for own in known):
        return columns, ()
    clock = np.flatnonzero(sound[response]).astype(float)
    filled = {
        name: replace(_held(Series(s.values[own], np.flatnonzero(own)), clock), t=None)
        for (name, s), own in zip(columns.items(), sound.values(), strict=True)
    }
    return filled, (f"no row is complete: the last number before each {response} is taken",)


def _complete(
    source: Source,
    names: tuple[list[str], list[str]],
    first: np.ndarray,
    second: np.ndarray,
    number: np.ndarray,
    t: np.ndarray | None,
    episode: np.ndarray | None,
    notes: tuple[str, ...],
) -> Columns:
    """Return the rows in which nothing is missing."""
    for group, values in zip(names, (first, second), strict=True):
        for name, column in zip(group, values.T, strict=True):
            if len(column) and not np.isfinite(column).any():
                raise ConfigurationError(
                    f"{printable(name)}: no number in {len(column)} rows; log it, or leave its "
                    "columns out"
                )
    sound = np.isfinite(first).all(1) & np.isfinite(second).all(1)
    for column in (t, episode):
        if column is not None:
            sound &= np.isfinite(column)
    lost = int((~sound).sum())
    if lost > 0.5 * len(sound) or len(sound) - lost < FEWEST:
        missing = f", {lost} of them with missing numbers" if lost else ""
        advice = "fill them, or name other columns" if lost else "log for a longer time"
        raise ConfigurationError(
            f"{len(sound)} rows{missing}: expected at least {FEWEST} complete ones, and half of "
            f"all; {advice}"
        )
    if lost:
        notes += (f"{lost} of {len(sound)} rows were dropped: numbers are missing or infinite",)
    rows = np.flatnonzero(sound)
    total, number = int(number[-1]) + 1, number[rows]
    if t is None:
        notes += ("no column t, time or timestamp: times are in rows",)
    time = number.astype(float) if t is None else t[rows]
    # Of a log that was read in blocks, each is an episode.
    apart = np.diff(number, prepend=number[0] - 1) > 1 + lost
    if episode is not None:
        apart |= np.diff(episode[rows], prepend=episode[rows[0]]) != 0
    border = np.cumsum(apart)
    back = np.flatnonzero((np.diff(time) <= 0) & (np.diff(border) == 0))
    if len(back):
        row = int(number[back[0] + 1])
        raise ConfigurationError(
            f"{printable(source.time or 't')} goes from {time[back[0]]:.6g} to "
            f"{time[back[0] + 1]:.6g} s at row {row}: expected ascending times, one each; sort the "
            "rows, log parts of seconds, or number episodes in a column episode_index"
        )
    if border[-1] > len(rows) / 2:
        raise ConfigurationError(
            f"{source.episode}: {border[-1] + 1} episodes in {len(rows)} rows: expected some of "
            "several rows; leave the column out, or see --episode"
        )
    arrays: Arrays = (first[rows], second[rows], time, border, number)
    if episode is not None:
        arrays, lacking = _thawed(arrays, episode[rows], source.frame)
        notes += lacking
    return Columns(names, *arrays, total, source.frame, notes)


def _thawed(arrays: Arrays, episode: np.ndarray, frame: float) -> tuple[Arrays, tuple[str, ...]]:
    """Return the rows without episodes whose responses are frozen, and what is to be said.

    Frames are a ``frame`` (s) apart, or, if it is 0, as far as rows are.
    """
    first, second, t, border, number = arrays
    notes, inside = [], np.diff(border) == 0
    steps = np.diff(t)[inside]
    if frame:
        gaps = np.round(steps / frame).clip(min=1) - 1
        if gaps.any():
            places = int((gaps > 0).sum())
            notes.append(
                f"missing frames: {int(gaps.sum())}, at {places} place{'s' * (places > 1)}"
            )
    rate = 1 / float(np.median(steps)) if len(steps) else 1.0
    still = frozen_rows(first, second, border, delay=max(10, round(0.35 * rate)))
    odd = frozen_episodes(still, border, 1.5 * rate if rate != 1.0 else np.inf)
    rows = ~np.isin(border, odd)
    if odd and rows.sum() >= FEWEST:
        numbers = np.unique(episode[~rows]).astype(int).tolist()
        notes.append(
            f"responses are frozen while commands move in {len(numbers)} of "
            f"{len(np.unique(episode))} episodes, which are left out: {listed(numbers)}"
        )
        first, second, t, border, number = (array[rows] for array in arrays)
    again = int((still[rows] > 0).sum())
    if frame and again:
        notes.append(f"frames that repeat the responses before, while commands move: {again}")
    return (first, second, t, border, number), tuple(notes)
