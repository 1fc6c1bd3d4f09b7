"""CSV files."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd

from afm_rl.diagnosis.readers.source import Series, Source, blocks_of, thinned_note
from afm_rl.errors import ConfigurationError, printable

TIME, EPISODE = "t", "episode_index"


def open_csv(path: Path) -> Source:
    """Return the columns of a CSV file with a head line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            head = file.readline(1 << 20)
            names = [name.strip() for name in next(csv.reader([head], skipinitialspace=True), [])]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"no CSV file: {printable(str(error))}") from error
    if not names:
        raise ConfigurationError("empty; expected a head line and rows")
    double = next((name for name in names if names.count(name) > 1 and name), None)
    if double is not None:
        raise ConfigurationError(f"{printable(double)}: two columns of this name; rename one")
    return Source(
        path,
        names,
        lambda wanted: _read(path, names, wanted),
        time=TIME if TIME in names else None,
        episode=EPISODE if EPISODE in names else None,
        notes=_large(path)[1],
    )


def _large(path: Path, large: int = 1 << 25) -> tuple[list[tuple[int, int, int]], tuple[str, ...]]:
    """Return the blocks of a large file: byte, row, and number of rows; and a note.

    A file of less than ``large`` bytes is read as a whole, and has none.
    """
    size, count = path.stat().st_size, len(blocks_of(1 << 60))
    if size < large:
        return [], ()
    starts, lines, before = [size * k // count for k in range(count)], [], 0
    with path.open("rb") as file:
        for start, end in zip(starts, [*starts[1:], size], strict=True):
            lines.append(before)
            file.seek(start)
            while start < end:
                piece = file.read(min(1 << 24, end - start))
                before, start = before + piece.count(b"\n"), start + len(piece)
    before -= 1  # the head line
    blocks = blocks_of(before)
    if len(blocks) == 1:
        return [], ()
    length = blocks[0][1]
    found = [(at, max(line, 0), length) for at, line in zip(starts, lines, strict=True)]
    return found, thinned_note(before, blocks)


def _read(path: Path, names: list[str], wanted: Sequence[str]) -> Mapping[str, Series]:
    blocks, _ = _large(path)
    if not blocks:
        table = _parse(path, names, wanted, skip=1)
        row = np.arange(len(table))
    else:
        parts, rows = [], []
        with path.open("rb") as file:
            for at, first, length in blocks:
                file.seek(at)
                file.readline()  # the head, or the rest of a row
                text = b"".join(islice(file, length))
                parts.append(_parse(io.BytesIO(text), names, wanted))
                rows.append(first + np.arange(len(parts[-1])))
        table, row = pd.concat(parts, ignore_index=True), np.concatenate(rows)
    return {name: Series(_numbers(name, table[name]), row=row) for name in wanted}


def _parse(
    file: Path | io.BytesIO, names: list[str], wanted: Sequence[str], skip: int = 0
) -> pd.DataFrame:
    """Return some columns of rows without a head line."""
    places = sorted(names.index(name) for name in wanted)
    try:
        return pd.read_csv(
            file,
            header=None,
            names=range(len(names)),
            usecols=places,
            skiprows=skip,
            skipinitialspace=True,
            low_memory=False,
            encoding="utf-8-sig",
            index_col=False,
        ).rename(columns=dict(enumerate(names)))
    except pd.errors.EmptyDataError:
        return pd.DataFrame({name: np.empty(0) for name in wanted})
    except (pd.errors.ParserError, ValueError, OverflowError) as error:
        raise ConfigurationError(f"no CSV file: {printable(str(error), 200)}") from error


def _numbers(name: str, column: pd.Series) -> np.ndarray:
    """Return a column as numbers, NaN where a cell is empty."""
    # A column with text holds objects, among them whole numbers of any size.
    cells = column.astype(str) if column.dtype == object else column
    numbers = pd.to_numeric(cells, errors="coerce")
    text = numbers.isna() & column.notna()
    if text.any():
        row = int(np.flatnonzero(text)[0])
        cell = printable(repr(column.iloc[row]), 40)
        raise ConfigurationError(f"{printable(name)}: {cell} in row {row}: expected a number")
    return numbers.to_numpy(dtype=float)
