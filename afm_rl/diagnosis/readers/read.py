"""A file or folder becomes a log."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from afm_rl.diagnosis.log import FEWEST, Log
from afm_rl.diagnosis.readers import messages, parquet, tables
from afm_rl.diagnosis.readers.angles import with_angles
from afm_rl.diagnosis.readers.source import (
    EFFECTIVE,
    MEASURED,
    Columns,
    Source,
    blocks_of,
    check_regular,
    choose,
    rows_of,
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
        table, row, filled = _table(source, wanted)
        _check_sizes(table)
        t, stretch, assumed = _times(source, table)
        first, second = (table[group].to_numpy(dtype=float) for group in wanted)
        episodes = np.zeros(len(row)) if source.episode is None else table[source.episode]
        total = int(row[-1]) + 1 if len(row) else 0
        thinned = thinned_note(row, max(source.rows, total))
        columns = Columns(
            names,
            first,
            second,
            t=row.astype(float) if t is None else t,
            episode=np.asarray(episodes, dtype=float),
            stretch=np.zeros(len(row), dtype=int) if stretch is None else stretch,
            row=row,
            read_from=total,
            frame=source.frame,
            notes=(*source.notes, *thinned, *assumed, *notes, *filled),
            effort=_effort(source),
            computed=all(name.split(".")[0] in EFFECTIVE for name in wanted[1]),
            doubts=_doubts(source, names[0], wanted) if kinds == PAIRS else {},
        )
        if len(row) == total and _take_turns(columns.episode):
            order = np.argsort(columns.episode, kind="stable")
            columns = replace(columns.part(order), row=row)
        return _complete(columns, source, t is not None)


def _table(
    source: Source, wanted: tuple[Sequence[str], Sequence[str]]
) -> tuple[pd.DataFrame, np.ndarray, tuple[str, ...]]:
    """Return what was logged, the numbers of the rows, and notes.

    Of messages there is a row for each of the first response, with the last of all others.
    """
    others = [name for name in (source.time, source.episode) if name is not None]
    logged = source.read(list(dict.fromkeys([*wanted[0], *wanted[1], *others])))
    if source.topics is None:
        table, notes = _filled(pd.DataFrame(logged), [*wanted[0], *wanted[1]], wanted[1][0])
        row = table.index.to_numpy()
    else:
        clock, notes = logged[wanted[1][0]].index, ()
        table = pd.DataFrame({n: x.reindex(clock, method="ffill") for n, x in logged.items()})
        row = np.arange(len(table))
    chosen = rows_of(blocks_of(len(table), table.shape[1]))
    return table.iloc[chosen], row[chosen], notes


def _filled(
    table: pd.DataFrame, names: Sequence[str], response: str
) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Return a table with a row per message as one with a row for each ``response``.

    There no row is complete, and the last number of each column counts.
    """
    sound = table.where(np.isfinite(table))
    known = sound[names].notna()
    if known.all(axis=1).any() or not known.any().all():
        return table, ()
    filled = sound.ffill()[sound[response].notna()].reset_index(drop=True)
    return filled, (f"no row is complete: the last number before each {response} is taken",)


def _check_sizes(table: pd.DataFrame) -> None:
    """Refuse numbers whose squares leave single precision."""
    large = np.isfinite(table) & (table.abs() >= LARGEST)
    for name in large.columns[large.any()]:
        raise ConfigurationError(
            f"{printable(name)}: row {large[name].argmax()}: expected numbers below {LARGEST:g}"
        )


def _times(
    source: Source, table: pd.DataFrame
) -> tuple[np.ndarray | None, np.ndarray | None, tuple[str, ...]]:
    """Return times (s), the numbers of the stretches between pauses, and what was assumed."""
    if source.topics is not None:
        return table.index.to_numpy(), None, ()
    if source.time is None:
        return None, None, ()
    time = table[source.time].to_numpy(dtype=float)
    if source.frame:
        return time, None, ()
    time, stretch, assumed = in_seconds(source.time, time)
    if len(np.unique(time[np.isfinite(time)])) == 1:
        return None, stretch, (f"{printable(source.time)} never changes",)
    return time, stretch, assumed


def _doubts(
    source: Source, names: Sequence[str], wanted: tuple[Sequence[str], Sequence[str]]
) -> dict[str, str]:
    """Return why nothing can be said of pairs that one message measures, by name."""
    doubts = {}
    for name, *pair in zip(names, *wanted, strict=True) if source.topics else ():
        first, second = (match and match[1] for match in map(MEASURED.fullmatch, pair))
        if first and first == second:
            doubts[printable(name)] = (
                f"{first} measures its command and its response in one message; name what was "
                "sent as the command"
            )
    return doubts


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
    finite = {name: x[np.isfinite(x)].to_numpy() for name, x in logged.items()}
    return {printable(name): values for name, values in finite.items() if len(values)}


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
