"""Reading track files: what is in a CSV, or one line on why it cannot be used."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError


def read_columns(
    path: str | Path, headers: Sequence[tuple[str, ...]]
) -> tuple[tuple[str, ...], Tensor]:
    """Read a CSV of finite numbers.

    Args:
        path: the file; its first line names the columns.
        headers: the sets of columns that are allowed.

    Returns:
        The header, and the numbers ``(R, C)`` in double precision.

    Raises:
        ConfigurationError: if the file is missing or is no text, has other columns, or holds
            a cell that is empty, superfluous or not a finite number. It names file and line.

    >>> read_columns(Path(__file__).with_name("maps") / "ethz_2.csv", [("x", "y", "radius")])[0]
    ('x', 'y', 'radius')
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [(i, line) for i, line in enumerate(csv.reader(file), start=1) if any(line)]
    except OSError as error:
        raise ConfigurationError(f"tracks: cannot read {path}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f"tracks: {path} is not a text file of columns") from error
    header = tuple(cell.strip().lower() for cell in lines[0][1]) if lines else ()
    if header not in headers:
        allowed = " or ".join(",".join(columns) for columns in headers)
        found = ",".join(header) or "nothing"
        raise ConfigurationError(f"tracks: {path}: the first line is {found}, expected {allowed}")
    rows = []
    for number, line in lines[1:]:
        if len(line) != len(header):
            raise ConfigurationError(
                f"tracks: {path}, line {number}: {len(line)} values, expected {len(header)}"
            )
        rows.append([_finite(cell, f"{path}, line {number}") for cell in line])
    return header, torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(header))


def _finite(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigurationError(f"tracks: {where}: {cell!r} is not a finite number")
    return value
