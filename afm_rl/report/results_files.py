"""Files of results, read as files of a stranger: bounded, checked, and named if they are refused.

Nothing in them is executed or interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet as parquet
import yaml

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.report.frames import outcome
from afm_rl.storage.csv_text import plain_text
from afm_rl.storage.measures import Measures

WORDS = ["method", "track", "regime"]  # text, whatever they look like
LONGEST = 500  # letters of a word
MEGABYTE = 2**20
DEEPEST = 50  # levels of settings
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
SETTINGS, TABLE, STEPS = 4 * MEGABYTE, 256 * MEGABYTE, 8192 * MEGABYTE  # largest files


def read_text(path: Path, most: int = SETTINGS) -> str:
    """Return a UTF-8 text file of a bounded size.

    Raises:
        ConfigurationError: if it cannot be read, is larger than ``most`` bytes, or is not UTF-8.
    """
    try:
        if not path.is_file():
            raise ConfigurationError(f"{path}: no such file")
        if path.stat().st_size > most:
            raise ConfigurationError(
                f"{path}: {path.stat().st_size} bytes; expected {most} at most"
            )
        return path.read_bytes().decode("utf-8")
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: no UTF-8 text: {error.reason}") from error


def read_settings(path: Path) -> dict[str, Any]:
    """Return a YAML file that holds a mapping, ``${...}`` in it left as it is.

    Values only: tags of other types are refused, and so are aliases, which grow without bounds.

    Raises:
        ConfigurationError: if it cannot be read, or holds something else.
    """
    text, depth = read_text(path), 0
    try:
        for event in yaml.parse(text, LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent):
                raise yaml.YAMLError("aliases (*name) are not read")
            if depth > DEEPEST:
                raise yaml.YAMLError(f"more than {DEEPEST} levels")
        found = yaml.load(text, LOADER)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise ConfigurationError(f"{path}: damaged: {_first_line(error)}") from error
    if not isinstance(found, dict):
        raise ConfigurationError(f"{path}: damaged; expected a mapping")
    return found


def read_measures(path: Path) -> Measures:
    """Return the measures that a run declared.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it is damaged.
    """
    try:
        return Measures.from_json(read_text(path))
    except ArtefactError as error:
        raise ArtefactError(f"{path}: {error}") from error


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
    read_text(path, TABLE)
    try:
        table = pd.read_csv(path, dtype=dict.fromkeys(WORDS, str), encoding="utf-8")
    except (ValueError, OverflowError, pd.errors.ParserError) as error:
        raise ConfigurationError(f"{path}: no table of values: {_first_line(error)}") from error
    missing = [name for name in [*others, *numbers] if name not in table]
    if missing:
        raise ConfigurationError(f"{path}: columns {', '.join(missing)} are missing")
    for name in numbers:
        empty = table[name].isna().all()
        if not empty and not (_is_number(table[name]) and not np.isinf(table[name]).any()):
            raise ConfigurationError(f"{path}: {name}: expected a finite number in each row")
    for name in (word for word in WORDS if word in table):
        texts = table[name]
        if len(texts) and (texts.isna().any() or texts.str.len().max() > LONGEST):
            raise ConfigurationError(
                f"{path}: {name}: expected a text of 1 to {LONGEST} letters in each row"
            )
        table[name] = texts.map(plain_text)
    return table


def read_missions(path: Path, measures: Measures) -> pd.DataFrame:
    """Return a table of missions, checked.

    Raises:
        ConfigurationError: if it cannot be read, a column is missing, or a value cannot be.
    """
    whole = ["seed", "steps", "mission"]
    head = read_text(path, TABLE).partition("\n")[0].strip().split(",")
    clock, ended = ["seconds"] if "seconds" in head else [], outcome(head)
    numbers = list(dict.fromkeys([*whole, *measures.columns, *clock]))
    missions = read_table(path, numbers, ["method", "track", ended])
    if not len(missions):
        return missions
    for name in whole:
        if missions[name].isna().any() or (missions[name] % 1 != 0).any():
            raise ConfigurationError(f"{path}: {name}: expected a whole number in each row")
    if missions[ended].dtype != bool:
        raise ConfigurationError(f"{path}: {ended}: expected True or False in each row")
    if missions["mission"].duplicated().any():
        raise ConfigurationError(f"{path}: mission: expected another number in each row")
    # Single precision as text has seven digits: 6/34 is the same number in all files again.
    reals = [m.column for m in measures if pd.api.types.is_float_dtype(missions[m.column])]
    return missions.assign(
        **{name: missions[name].map("{:.6g}".format).astype(float) for name in reals}
    )


def step_columns(path: Path) -> list[str]:
    """Return the names of the columns of a file of steps.

    Raises:
        ConfigurationError: if it cannot be read, or is too large.
    """
    return list(_opened(path).schema_arrow.names)


def read_steps(
    files: Sequence[Path], missions: pd.DataFrame, columns: Sequence[str] | None = None
) -> pd.DataFrame:
    """Return the steps of some missions, under the numbers that ``missions`` gives them.

    Only the missions and columns asked for stay in memory.

    Args:
        files: the files of steps.
        missions: rows of :attr:`~afm_rl.report.collect.Collection.missions`.
        columns: what to read beside ``mission`` and ``t``; a column that a file lacks is NaN.
            None: all.

    Returns:
        One row per mission and step, in their order.

    Raises:
        ConfigurationError: if a file cannot be read, or holds something else than numbers.
    """
    parts = []
    names = None if columns is None else list(dict.fromkeys(["mission", "t", *columns]))
    for place, rows in missions[missions["file"] >= 0].groupby("file"):
        path, new = files[place], rows.set_index("own")["mission"]
        there = step_columns(path)
        wanted = [name for name in names or there if name in there]
        if not {"mission", "t"} <= set(wanted) or len(set(there)) < len(there):
            raise ConfigurationError(f"{path}: expected the columns mission and t, each name once")
        try:
            table = parquet.read_table(
                path, columns=wanted, filters=[("mission", "in", new.index.tolist())]
            )
            part = table.to_pandas(ignore_metadata=True)
        except (OSError, ValueError, MemoryError, pyarrow.ArrowException) as error:
            raise ConfigurationError(f"{path}: damaged: {_first_line(error)}") from error
        strange = [name for name in part if not _is_number(part[name])]
        if strange or part[["mission", "t"]].isna().any(axis=None):
            raise ConfigurationError(f"{path}: {', '.join(strange) or 't'}: expected numbers")
        parts.append(part.assign(mission=part["mission"].map(new)))
    joined = pd.concat(parts) if parts else pd.DataFrame(columns=names or ["mission", "t"])
    return joined.reindex(columns=names or list(joined)).sort_values(
        ["mission", "t"], ignore_index=True
    )


def _opened(path: Path) -> parquet.ParquetFile:
    try:
        file = parquet.ParquetFile(path)
        groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
    except (OSError, ValueError, pyarrow.ArrowException) as error:
        raise ConfigurationError(f"{path}: damaged, or no Parquet file") from error
    size = sum(group.total_byte_size for group in groups)
    if size > STEPS:
        raise ConfigurationError(f"{path}: {size} bytes unpacked; expected {STEPS} at most")
    return file


def _is_number(values: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(values) and not pd.api.types.is_complex_dtype(values)


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:200]
