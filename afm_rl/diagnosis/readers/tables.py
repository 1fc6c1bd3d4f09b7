"""CSV files, as spreadsheets of any country write them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pandas as pd

from afm_rl.diagnosis.readers.source import Source
from afm_rl.diagnosis.readers.times import TIME, numbers_of, time_among
from afm_rl.errors import ConfigurationError, printable, refusing

EPISODE = "episode_index"
LINE = 1 << 20
"""Longest line (bytes)."""


def open_csv(path: Path) -> Source:
    """Return the columns of a CSV file with a header."""
    with refusing("no CSV file"), path.open(encoding="utf-8-sig", newline="") as file:
        head, first = file.readline(LINE), file.readline(LINE)
        if head.startswith("#"):  # as np.savetxt writes it
            head = head[1:].lstrip()
        style = _style(head, first)
        names = [name or str(place) for place, name in enumerate(_cells(head, style))]
    if not names:
        raise ConfigurationError("empty; expected a header and rows")
    if len(head) == LINE:
        raise ConfigurationError(f"a line of more than {LINE:,} bytes: expected a header")
    if all(_is_number(name) for name in names):
        raise ConfigurationError(
            "the first line has numbers only: expected a header with the names of the columns, "
            "such as t,command.NAME,response.NAME; add one"
        )
    return Source(
        path,
        names,
        lambda wanted: _read(path, names, wanted, style),
        time=time_among(names),
        episode=EPISODE if EPISODE in names else None,
    )


def _style(head: str, first: str) -> dict[str, str]:
    """Return what separates columns, and what stands before decimals, by the first two lines.

    >>> _style("t;command.a", "0,5;1,25"), _style("t,command.a", "0.5,1")
    ({'sep': ';', 'decimal': ','}, {'sep': ',', 'decimal': '.'})
    """
    sep = max(",;\t", key=head.count)
    comma = sep != "," and re.search(r"\d,\d", first) and not re.search(r"\d\.\d", first)
    return {"sep": sep, "decimal": "," if comma else "."}


def _cells(line: str, style: Mapping[str, str]) -> list[str]:
    """Return the cells of a line, without spaces around them."""
    rows = csv.reader([line], delimiter=style["sep"], skipinitialspace=True)
    return [cell.strip() for cell in next(rows, [])]


def _check_cells(lines: Iterable[bytes], names: int, style: Mapping[str, str]) -> None:
    """Refuse rows of more cells than names; one empty cell at the end is none."""
    separator = style["sep"].encode()
    for row, line in enumerate(lines, 1):
        if line.count(separator) < names:
            continue
        cells = _cells(line.decode(errors="replace"), style)
        if len(cells) > names + (not cells[-1]):
            raise ConfigurationError(
                f"row {row} has {len(cells)} cells, the header {names} names: expected as many; "
                "name all columns in the header"
            )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _line(file: BinaryIO) -> bytes:
    line = file.readline(LINE)
    if len(line) == LINE:
        raise ConfigurationError(f"a line of more than {LINE:,} bytes: expected rows of numbers")
    return line


def _read(
    path: Path, names: list[str], wanted: Sequence[str], style: Mapping[str, str]
) -> Mapping[str, pd.Series]:
    """Return some columns."""
    with path.open("rb") as file:
        _line(file)
        _check_cells(iter(partial(_line, file), b""), len(names), style)
    with refusing("no CSV file"):
        table = pd.read_csv(
            path,
            header=0,
            names=names,
            usecols=wanted,
            skipinitialspace=True,
            low_memory=False,
            encoding="utf-8-sig",
            index_col=False,
            sep=style["sep"],
            decimal=style["decimal"],
        )
    return {name: pd.Series(_numbers(name, table[name])) for name in wanted}


def _numbers(name: str, column: pd.Series) -> np.ndarray:
    """Return a column as numbers, NaN where a cell is empty."""
    # A column with text holds objects, among them whole numbers of any size.
    cells = column.astype(str) if column.dtype == object else column
    numbers = pd.to_numeric(cells, errors="coerce")
    text = numbers.isna() & column.notna()
    if text.any() and TIME.fullmatch(name):
        return numbers_of(name, column)
    if text.any():
        row = int(np.flatnonzero(text)[0])
        cell = printable(repr(column.iloc[row]), 40)
        raise ConfigurationError(f"{printable(name)}: {cell} in row {row}: expected a number")
    return numbers.to_numpy(dtype=float)
