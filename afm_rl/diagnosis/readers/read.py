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
from afm_rl.errors import ConfigurationError, causes, printable
from afm_rl.storage.child import data_size

PAIRS = ("command", "response")
TRANSITIONS = ("action", "state")

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
CONVERTERS = {
    ".h5 .hdf5 .hdf": "write its arrays to CSV or parquet, with h5py and pandas.DataFrame.to_csv",
    ".bin .tlog": "convert it with pymavlink: mavlogdump.py --format csv --types TYPE FILE",
    ".bbl .bfl": "convert it with Betaflight's blackbox-tools: blackbox_decode FILE",
    ".mat": "write it to CSV, with scipy.io.loadmat and pandas.DataFrame.to_csv",
    ".npz .npy": "write it to CSV, with numpy.load and numpy.savetxt(..., header=NAMES)",
    ".xlsx .xls .ods": "save the sheet as CSV",
    ".json .jsonl": "write it to CSV, with pandas.read_json and pandas.DataFrame.to_csv",
    ".feather .arrow": "write it to parquet, with pandas.read_feather and DataFrame.to_parquet",
    ".rrd": "convert it with the rerun SDK: its dataframe API writes parquet",
    ".pkl .pickle .pt": "write it to CSV or parquet where you trust it: reading it here runs code",
    ".txt .dat .log": "if it is a table with commas, tabs or semicolons, rename it to .csv",
}
"""How to get one of these from files that are not read, by the ends of their names."""
EXPECTED = (
    "expected a file .csv, .tsv, .parquet, .ulg, .mcap, .db3 or .bag, or a folder of LeRobot or ROS"
)


def open_source(path: Path) -> Source:
    """Return what there is in a file or folder."""
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
    kind = check_regular(path).suffix.lower()
    if kind in READERS:
        return READERS[kind](path)
    advice = next((how for kinds, how in CONVERTERS.items() if kind in kinds.split()), "")
    advice = advice or "export the log as one of these"
    raise ConfigurationError(f"{path}: {EXPECTED}; {advice}")


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
    if (used := data_size()) is None:
        yield
        return
    import resource

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
        source = with_angles(open_source(path))
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
        stretch = None
        if source.time and time is not None and not source.frame:
            time, stretch, assumed = in_seconds(source.time, time)
            if len(np.unique(time[np.isfinite(time)])) == 1:
                time, assumed = None, (f"{printable(source.time)} never changes",)
        leading = columns[wanted[0][0]]
        number = np.arange(len(first)) if leading.row is None else leading.row
        doubts = {}
        for name, *pair in zip(names[0], *wanted, strict=False) if kinds == PAIRS else ():
            first_topic, second_topic = (m and m[1] for m in map(MEASURED.fullmatch, pair))
            if source.topics and first_topic and first_topic == second_topic:
                doubts[printable(name)] = (
                    f"{first_topic} measures its command and its response in one message; name "
                    "what was sent as the command"
                )
        table = Columns(
            names,
            first,
            second,
            t=number.astype(float) if time is None else time,
            episode=columns[source.episode].values if source.episode else np.zeros(len(first)),
            stretch=np.zeros(len(first), dtype=int) if stretch is None else stretch,
            row=number,
            read_from=int(number[-1]) + 1 if len(number) else 0,
            frame=source.frame,
            notes=(*source.notes, *thinned_note(number, leading.rows), *assumed, *notes),
            effort=_effort(source),
            computed=all(name.split(".")[0] in EFFECTIVE for name in wanted[1]),
            doubts=doubts,
        )
        if len(number) == table.read_from and _take_turns(table.episode):
            table = replace(table.part(np.argsort(table.episode, kind="stable")), row=number)
        return _complete(table, source, time is not None)


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
    except (ConfigurationError, MemoryError) as error:
        if any(isinstance(cause, MemoryError) for cause in causes(error)):
            raise ConfigurationError(f"{path}: not enough memory; log less at a time") from error
        begin, text = (printable(str(x), 4000) for x in (path, error))
        text = text.removeprefix("log: ")
        if not text.startswith(begin):
            error.args = (f"{begin}: {text}",)
        raise
    except RecursionError as error:
        raise ConfigurationError(f"{path}: nested too deeply; expected a log") from error


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


def _complete(table: Columns, source: Source, timed: bool) -> Columns:
    """Return the rows in which nothing is missing."""
    for group, values in zip(table.names, (table.first, table.second), strict=True):
        for name, column in zip(group, values.T, strict=True):
            if len(column) and not np.isfinite(column).any():
                raise ConfigurationError(
                    f"{printable(name)}: no number in {len(column)} rows; log it, or omit its "
                    "columns"
                )
    numbers = np.column_stack([table.first, table.second, table.t, table.episode])
    sound, notes = np.isfinite(numbers).all(1), table.notes
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
    if not timed:
        notes += ("no column t, time or timestamp: times are in rows",)
    table = table.part(sound)
    t, row, episode = table.t, table.row, table.episode
    # Of a log that was read in blocks, each is an episode.
    apart = np.diff(row, prepend=row[0] - 1) > 1 + lost
    apart |= np.diff(table.stretch, prepend=table.stretch[0]) != 0
    border = np.cumsum(apart | (np.diff(episode, prepend=episode[0]) != 0))
    back = np.flatnonzero((np.diff(t) <= 0) & (np.diff(border) == 0))
    if len(back):
        last, here = back[0], back[0] + 1
        raise ConfigurationError(
            f"{printable(source.time or 't')} goes from {t[last]:.6g} to {t[here]:.6g} s at row "
            f"{row[here]}: expected ascending times, one each; sort the rows, log parts of "
            "seconds, or number episodes in a column episode_index"
        )
    if border[-1] > len(t) / 2:
        raise ConfigurationError(
            f"{source.episode}: {border[-1] + 1} episodes in {len(t)} rows: expected some of "
            "several rows; omit the column, or see --episode"
        )
    table = replace(table, episode=border, notes=notes)
    return _thawed(table, episode) if source.episode else table


def _thawed(table: Columns, episode: np.ndarray) -> Columns:
    """Return the rows without episodes whose responses are frozen; notes name their numbers.

    Frames are a ``frame`` (s) apart, or, if it is 0, as far as rows are.
    """
    frame, border, notes = table.frame, table.episode, []
    steps = np.diff(table.t)[np.diff(border) == 0]
    if frame:
        gaps = np.round(steps / frame).clip(min=1) - 1
        if gaps.any():
            places = int((gaps > 0).sum())
            notes.append(
                f"missing frames: {int(gaps.sum())}, at {places} place{'s' * (places > 1)}"
            )
    rate = 1 / float(np.median(steps)) if len(steps) else 1.0
    still = frozen_rows(table.first, table.second, border, delay=max(10, round(0.35 * rate)))
    odd = frozen_episodes(still, border, 1.5 * rate if rate != 1.0 else np.inf)
    rows = ~np.isin(border, odd)
    if odd and rows.sum() >= FEWEST:
        numbers = np.unique(episode[~rows]).astype(int).tolist()
        notes.append(
            f"responses are frozen while commands move in {len(numbers)} of "
            f"{len(np.unique(episode))} episodes, which are left out: {listed(numbers)}"
        )
        table = table.part(rows)
    again = int((still[rows] > 0).sum())
    if frame and again:
        notes.append(f"frames that repeat the responses before, while commands move: {again}")
    return replace(table, notes=(*table.notes, *notes))
