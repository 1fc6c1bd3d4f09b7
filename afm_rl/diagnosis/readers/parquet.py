"""Parquet files, and LeRobot's data sets of them, versions 2 and 3."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as arrow
import pyarrow.compute as compute
import pyarrow.parquet as parquet

from afm_rl.diagnosis.readers.source import (
    ACTIONS,
    NAMES,
    STATES,
    WIDEST,
    Pointer,
    Source,
    blocks_of,
    check_names,
    check_regular,
    rows_of,
)
from afm_rl.diagnosis.readers.tables import EPISODE
from afm_rl.diagnosis.readers.telemetry import listed
from afm_rl.diagnosis.readers.times import TIME, numbers_of, time_among
from afm_rl.errors import ConfigurationError, printable, refusing

STAMP = "timestamp"
LISTS = (arrow.types.is_list, arrow.types.is_large_list, arrow.types.is_fixed_size_list)
INFO = "meta/info.json"
FASTEST, SLOWEST = 1e6, 1e-3  # rates (1/s) that a robot may have
DECODED = 10**9
"""Most numbers that are unpacked to read a log."""
BATCH = 1 << 12
"""Rows that are unpacked at once."""


def open_parquet(path: Path) -> Source:
    """Return the columns of a parquet file; a list's numbers are called ``COLUMN.0`` and so on.

    The numbers of a list of more than ``WIDEST``, as of an image, have no names.
    """
    names: dict[str, tuple[str, int | None]] = {}
    for column, width in widths_of(path, columns_of(path)).items():
        names |= _named(column, width)
    return source_of(path, [path], names, time_among(list(names)))


def source_of(
    path: Path,
    files: Sequence[Path],
    names: Mapping[str, tuple[str, int | None]],
    time: str | None,
    episode: str = EPISODE,
    frame: float = 0.0,
    notes: tuple[str, ...] = (),
) -> Source:
    """Return the rows of parquet files, one after the other, as a source."""
    total, widths = sum(map(_rows, files)), Counter(column for column, _ in names.values())

    def read(wanted: Sequence[str]) -> dict[str, pd.Series]:
        columns = list(dict.fromkeys(names[name][0] for name in wanted))
        width = sum(widths[column] for column in columns)
        if total * width > DECODED:
            raise ConfigurationError(
                f"{total:,} rows of {width:,} numbers: expected at most {DECODED:,} numbers in "
                "all; name fewer columns, or split the data"
            )
        row = rows_of(blocks_of(total, width))
        arrays, series = _read(files, columns, row), {}
        for name in wanted:
            column, place = names[name]
            values = arrays[column]
            if (values.ndim == 1) != (place is None) or (place or 0) >= values.shape[-1]:
                expected = "one number a row" if place is None else f"lists of more than {place}"
                raise ConfigurationError(f"{printable(column)}: expected {expected}")
            values = values if place is None else values[:, place]
            series[name] = pd.Series(values, row[: len(values)])
        return series

    at, number = (name if name in names else None for name in (time, episode))
    return Source(path, list(names), read, frame, at, number, rows=total, notes=notes)


def columns_of(file: Path) -> dict[str, arrow.DataType]:
    """Return names and types of the columns of a file."""
    with refusing(_no_parquet(file)):
        schema = parquet.read_schema(file)
    return dict(zip(check_names(schema.names), schema.types, strict=True))


def widths_of(file: Path, columns: Iterable[str]) -> dict[str, int | None]:
    """Return how many numbers the lists of each column have; None: it has no lists of numbers.

    It is the mean, which is known without reading them.
    """
    widths: dict[str, int | None] = dict.fromkeys(columns)
    leaves, first = dict[str, int](), 0
    with refusing(_no_parquet(file)):
        opened = parquet.ParquetFile(file)
        stored, schema = opened.metadata, opened.schema_arrow
        groups = [stored.row_group(k) for k in range(stored.num_row_groups)]
        for field in schema:  # the number of its first column, as parquet counts them
            leaves[field.name], first = first, first + _leaves(field.type)
        for name in widths:
            kind = schema.field(name).type
            if kind != _innermost(kind) and _is_number(_innermost(kind)):
                count = sum(group.column(leaves[name]).num_values for group in groups)
                widths[name] = round(count / max(stored.num_rows, 1))
    return widths


def check_kind(column: str, kind: arrow.DataType) -> None:
    """Refuse a column of something else than numbers, and lists of them."""
    if not (_is_number(_innermost(kind)) or _is_date(kind) and TIME.fullmatch(column)):
        raise ConfigurationError(f"{printable(column)}: {kind}: expected numbers, or lists of them")


def _is_number(kind: arrow.DataType) -> bool:
    types = arrow.types
    return types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)


def _is_date(kind: arrow.DataType) -> bool:
    types = arrow.types
    text = types.is_string(kind) or types.is_large_string(kind)
    return text or types.is_timestamp(kind) or types.is_date(kind)


def _innermost(kind: arrow.DataType) -> arrow.DataType:
    while any(is_list(kind) for is_list in LISTS):
        kind = kind.value_type
    return kind


def _leaves(kind: arrow.DataType) -> int:
    inner = (kind.field(k).type for k in range(kind.num_fields))
    return sum(_leaves(each) for each in inner) or 1


def check_width(column: str, width: int | None) -> None:
    """Refuse lists that are too long for each of their numbers to have a name."""
    if width is not None and width > WIDEST:
        raise ConfigurationError(
            f"{printable(column)}: {width:,} numbers a row: expected lists of at most {WIDEST:,}"
        )


def _rows(file: Path) -> int:
    with refusing(_no_parquet(file)):
        return parquet.read_metadata(file).num_rows


def _read(files: Sequence[Path], columns: list[str], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return some rows, by ascending numbers, of columns ``(N,)`` or ``(N, K)``."""
    parts: dict[str, list[np.ndarray]] = {column: [] for column in columns}
    begin = 0
    for file in files:
        kinds = columns_of(file)
        for column, longest in widths_of(file, columns).items():
            check_width(column, longest)
            check_kind(column, kinds[column])
        with refusing(_no_parquet(file)):
            for batch in parquet.ParquetFile(file).iter_batches(BATCH, columns=columns):
                first, last = np.searchsorted(rows, [begin, begin + len(batch)])
                chosen = batch.take(arrow.array(rows[first:last] - begin))
                for column in columns if last > first else ():
                    parts[column].append(_values(column, chosen.column(column)))
                begin += len(batch)
    for column, arrays in parts.items():
        lengths = {str(part.shape[1]) if part.ndim > 1 else "single" for part in arrays}
        if len(lengths) > 1:
            raise ConfigurationError(
                f"{printable(column)}: lists of {' and '.join(sorted(lengths)[:8])} numbers: "
                "expected one length"
            )
    return {name: np.concatenate(arrays or [np.empty(0)]) for name, arrays in parts.items()}


def _values(name: str, column: arrow.Array) -> np.ndarray:
    """Return a column of numbers ``(N,)``, NaN where one is missing, or of lists ``(N, K)``."""
    if any(is_list(column.type) for is_list in LISTS):
        widths = compute.unique(compute.list_value_length(column)).to_pylist()
        if len(widths) != 1 or widths[0] is None:
            raise ConfigurationError(
                f"{printable(name)}: lists of {' and '.join(str(w or 'no') for w in widths[:8])} "
                "numbers: expected lists of numbers of one length"
            )
        return _values(name, column.flatten()).reshape(len(column), widths[0])
    if _is_date(column.type):
        return numbers_of(name, column.to_pandas())
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return column.to_numpy(zero_copy_only=False).astype(float)


def _no_parquet(file: Path) -> str:
    return f"{printable(str(file), 200)}: no parquet file"


def open_lerobot(folder: Path) -> Source:
    """Return actions and states of a data set: ``action.NAME``, ``observation.state.NAME``.

    A state is read before the action is sent, so that a healthy robot is late by one frame. Other
    columns of numbers have names, too.
    """
    info, fps = _info(check_regular(folder / INFO))
    files, notes = _files(folder)
    for file in files:
        if EPISODE not in columns_of(file):
            raise ConfigurationError(f"{file}: no column {EPISODE}")
        check_kind(EPISODE, columns_of(file)[EPISODE])
    columns = columns_of(files[0])
    names: dict[str, tuple[str, int | None]] = {}
    numbers = [name for name, kind in columns.items() if _is_number(_innermost(kind))]
    for column, width in widths_of(files[0], numbers).items():
        names |= _named(column, width, info["features"].get(column))
    every = all(STAMP in columns_of(file) for file in files)
    if not every:
        names.pop(STAMP, None)
    notes += _missing(files, info)
    source = source_of(folder, files, names, STAMP, EPISODE, 1 / fps, notes)

    def read(wanted: Sequence[str]) -> dict[str, pd.Series]:
        series = dict(source.read([name for name in wanted if name in names]))
        row = next(iter(series.values())).index
        t = series[STAMP] if every else pd.Series(row / fps, row)
        whole = (t * fps).round() / fps  # stored in single precision, a little off
        return series | {STAMP: t.where((t - whole).abs() >= 0.02 / fps, whole)}

    return replace(source, read=read, time=STAMP)


def _missing(files: Sequence[Path], info: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what must be said where there are fewer frames or episodes than a data set states."""
    notes = []
    rows, frames = sum(_rows(file) for file in files), info.get("total_frames")
    if type(frames) is int and frames > rows:
        notes.append(f"{rows:,} of {frames:,} frames are there (total_frames in {INFO})")
    episodes = info.get("total_episodes")
    if type(episodes) is int and 0 < episodes <= NAMES and rows <= DECODED // 10:
        there = {*_read(files, [EPISODE], np.arange(rows))[EPISODE].tolist()}
        missing = [number for number in range(episodes) if number not in there]
        if len(there) < episodes:
            notes.append(f"missing episodes: {len(missing)} of {episodes}, {listed(missing)}")
    return tuple(notes)


def _info(file: Path) -> tuple[dict[str, Any], float]:
    """Return what a data set says of itself, and its rate (1/s)."""
    with refusing(f"{INFO}: damaged; expected fps, and features"):
        with file.open(encoding="utf-8") as text:
            info = json.loads(text.read(1 << 24))
        fps = float(info["fps"])
        if not isinstance(info["features"], dict):
            raise TypeError("features")
    if not SLOWEST <= fps <= FASTEST:
        raise ConfigurationError(
            f"{INFO}: fps={fps}: expected a rate between {SLOWEST:g} and {FASTEST:g}"
        )
    return info, fps


def _files(folder: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return the parquet files of a data set, and notes of what was skipped."""
    files, others, pointers = sorted(folder.glob("data/chunk-*/*.parquet")), [], []
    regular = []
    for file in files:
        try:
            regular.append(check_regular(file))
        except Pointer:
            pointers.append(file)
        except ConfigurationError:
            others.append(file)
    if pointers and not regular:
        check_regular(pointers[0])
    if not regular:
        raise ConfigurationError("no data/chunk-*/*.parquet: expected at least one file")
    skipped = {"no regular file": others, "pointers of Git LFS (run git lfs pull)": pointers}
    return regular, tuple(
        f"skipped, {what}: {len(some)} of {len(files)} files, {', '.join(shown)}"
        for what, some in skipped.items()
        if (shown := [printable(file.name) for file in some[:8]])
    )


def _named(
    column: str, width: int | None, feature: Any = None
) -> dict[str, tuple[str, int | None]]:
    """Return the names of a column's numbers: as its feature has them, or their places.

    Raises:
        ConfigurationError: for names of actions and states that cannot be used.
    """
    expected = column in (*ACTIONS, *STATES)
    if expected:
        check_width(column, width)
    elif width is None or width > WIDEST:  # one number is no list
        return {column: (column, None)}
    places: list[int | None] = [None] if width is None else list(range(width))
    given = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(given, dict) and all(type(place) is int for place in given.values()):
        given = sorted(given, key=given.__getitem__)
    with refusing(f"{INFO}: {column}: names nested too deeply"):
        names = list(_flat(given))
    fits = len(names) == len(set(names)) == len(places)
    if names and not fits and expected:
        raise ConfigurationError(
            f"{INFO}: {column}: two of the {len(places)} names are the same"
            if len(names) == len(places)
            else f"{column}: {len(places)} numbers per row, but {len(names)} names in {INFO}"
        )
    names = names if fits else [str(place) for place in range(len(places))]
    return {f"{column}.{n}": (column, place) for n, place in zip(names, places, strict=True)}


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
