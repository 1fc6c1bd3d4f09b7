"""Files that anybody may have written: bounded, checked, and named if they are refused.

Nothing in them is executed or interpolated.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as parquet

from afm_rl.errors import ConfigurationError, refusing
from afm_rl.storage.files import plain_text, read_bounded

WORDS = ["method", "track", "regime"]  # text, whatever they look like
LONGEST = 500  # letters of a word
MEGABYTE = 2**20


def read_text(path: Path, most: int = 4 * MEGABYTE) -> str:
    """Return a UTF-8 text file of at most so many bytes.

    Raises:
        ConfigurationError: if it cannot be read, is larger, or is not UTF-8.
    """
    with refusing(f"{path}: no UTF-8 text"):
        return read_bounded(path, most).decode("utf-8")


def read_table(path: Path, numbers: Sequence[str], others: Sequence[str] = ()) -> pd.DataFrame:
    """Return a CSV file that has at least these columns.

    Args:
        path: the file.
        numbers: columns of numbers, or of nothing where there is none; never infinite.
        others: columns of any kind.

    Raises:
        ConfigurationError: if it cannot be read, a column is missing, or a value is of the wrong
            kind.
    """
    text = io.StringIO(read_text(path, 256 * MEGABYTE))
    with refusing(f"{path}: no table of values"):
        table = pd.read_csv(text, dtype=dict.fromkeys(WORDS, str))
    missing = [name for name in [*others, *numbers] if name not in table]
    if missing:
        raise ConfigurationError(f"{path}: columns {', '.join(missing)} are missing")
    for name in numbers:
        values = table[name]
        if values.notna().any() and not (_is_number(values) and not np.isinf(values).any()):
            raise ConfigurationError(f"{path}: {name}: expected a finite number in each row")
    for name in (word for word in WORDS if word in table):
        texts = table[name]
        if len(texts) and (texts.isna().any() or texts.str.len().max() > LONGEST):
            raise ConfigurationError(
                f"{path}: {name}: expected a text of 1 to {LONGEST} letters in each row"
            )
        table[name] = texts.map(plain_text)
    return table


def read_numbers(
    path: Path, missions: Sequence[int], columns: Sequence[str] | None = None
) -> pd.DataFrame:
    """Return the steps of some missions from a Parquet file that holds numbers only.

    Only the missions and columns asked for stay in memory.

    Args:
        path: the file; at most 8 GiB when unpacked.
        missions: their numbers in this file.
        columns: those that the file lacks are left out. None: all.

    Raises:
        ConfigurationError: if it cannot be read, or holds something else than numbers.
    """
    limit = 8192 * MEGABYTE
    with refusing(f"{path}: damaged, or no Parquet file"):
        file = parquet.ParquetFile(path)
        size = sum(
            file.metadata.row_group(k).total_byte_size for k in range(file.metadata.num_row_groups)
        )
        there = list(file.schema_arrow.names)
    if size > limit:
        raise ConfigurationError(f"{path}: {size} bytes unpacked; expected {limit} at most")
    wanted = there if columns is None else [name for name in columns if name in there]
    if not {"mission", "t"} <= set(wanted) or len(set(there)) < len(there):
        raise ConfigurationError(f"{path}: expected the columns mission and t, each name once")
    with refusing(f"{path}: damaged"):
        chosen = [("mission", "in", list(missions))]
        table = parquet.read_table(path, columns=wanted, filters=chosen)
        steps = table.to_pandas(ignore_metadata=True)
    strange = [name for name in steps if not _is_number(steps[name])]
    if strange or steps[["mission", "t"]].isna().any(axis=None):
        raise ConfigurationError(f"{path}: {', '.join(strange) or 't'}: expected numbers")
    return steps


def _is_number(values: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_complex_dtype(values)
