"""Files that are written whole or not at all, YAML, tables as CSV, and locks of folders."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from filelock import FileLock, Timeout

from afm_rl.errors import ArtefactError, ConfigurationError, refusing

if TYPE_CHECKING:
    import pandas as pd

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_yaml(text: str | bytes) -> Any:
    """Return the values of a YAML text that anybody may have written.

    ``${...}`` in it is left as it is; tags of other types are refused.

    Raises:
        yaml.YAMLError: if :func:`check_yaml` refuses it, or it is something else.

    >>> read_yaml("seeds: [1, 2]")
    {'seeds': [1, 2]}
    """
    check_yaml(text, LOADER)
    return yaml.load(text, LOADER)


def check_yaml(text: str | bytes, loader: Any, deepest: int = 50) -> None:
    """Check that a YAML text has no aliases, which grow without bounds, and not too many levels.

    Raises:
        yaml.YAMLError: if it has.
    """
    depth = 0
    for event in yaml.parse(text, loader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not read")
        if depth > deepest:
            raise yaml.YAMLError(f"more than {deepest} levels")


def file_name(name: str, longest: int = 120) -> str:
    """Return a name for a file or folder: readable, and another one for every name.

    >>> file_name("physics+planner.horizon=5")
    'physics+planner.horizon=5'
    >>> file_name("physics+tracks=[a/b]")
    'physics+tracks=_a_b_-32a2f2'
    """
    plain = re.sub(r"[^-+.,=\w]", "_", name).lstrip(".")[:longest]
    digest = hashlib.sha256(name.encode()).hexdigest()[:6]
    return name if plain == name else f"{plain}-{digest}"


def read_bounded(path: Path, most: int) -> bytes:
    """Return the content of a file that anybody may have written.

    Raises:
        ConfigurationError: if there is none, it cannot be read, or has more than ``most`` bytes.
    """
    if not path.is_file():
        raise ConfigurationError(f"{path}: no such file")
    with refusing(str(path)):
        size = path.stat().st_size
        if size > most:
            raise ConfigurationError(f"{path}: {size} bytes; expected {most} at most")
        return path.read_bytes()


def read_settings(path: Path, data: bytes | None = None) -> dict[str, Any]:
    """Return a YAML file that holds a mapping, as :func:`read_yaml` reads it.

    Args:
        path: of the file.
        data: what is in it, where that is known; of what is read, 4 MiB at most.

    Raises:
        ConfigurationError: if there is no such file, or it is larger.
        ArtefactError: if it holds something else.
    """
    with refusing(f"{path}: damaged; delete it", ArtefactError):
        return dict(read_yaml(read_bounded(path, 2**22) if data is None else data).items())


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that readers see the old content or the new, never a part.

    The content and the file's name are on the disk when this returns.

    Raises:
        ConfigurationError: if the file cannot be written.
    """
    with refusing(f"cannot write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{secrets.token_hex(6)}")
        try:
            with open(part, "xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
        sync_folder(path.parent)


def remove_parts(folder: Path, name: str = "*") -> None:
    """Remove what a killed :func:`write_whole` may have left beside files of a name.

    Only for files that no other process writes at the same time.
    """
    for part in folder.glob(f".{name}.{'[0-9a-f]' * 12}"):
        part.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Write to the disk which files a folder holds."""
    if os.name != "posix":  # elsewhere a folder cannot be opened
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


@contextmanager
def locked(folder: Path, name: str = ".lock", wait: bool = False) -> Iterator[None]:
    """Hold the lock of a folder, which is made if it is not there.

    The lock ends with the process that holds it, however that ends.

    Args:
        folder: where the file of the lock is; it stays.
        name: of this file.
        wait: wait for another process to let go.

    Raises:
        ConfigurationError: if another process holds the lock, or the folder cannot be written.
    """
    with refusing(f"cannot write {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock = FileLock(folder / name, timeout=-1 if wait else 0).acquire()
        except Timeout:
            raise ConfigurationError(
                f"{folder}: another process uses this folder; wait for it, or end it"
            ) from None
    with lock:
        yield


def csv_text(table: pd.DataFrame) -> str:
    """Return a table as CSV; a text that looks like a formula gets an apostrophe in front.

    >>> import pandas as pd
    >>> print(csv_text(pd.DataFrame({"method": ["=cmd|' /C calc'!A0", "-1.5"]})), end="")
    method
    '=cmd|' /C calc'!A0
    -1.5
    """
    texts = table.select_dtypes(["object", "string", "category"])
    safe = {name: texts[name].map(_quote) for name in texts}
    return table.assign(**safe).to_csv(index=False, lineterminator="\n")


def plain_text(text: object) -> object:
    """Return a cell as it was before :func:`csv_text` put an apostrophe in front.

    >>> plain_text("'=1+1"), plain_text("'tis")
    ('=1+1', "'tis")
    """
    return text[1:] if isinstance(text, str) and re.match(r"'[=+\-@\t\r]", text) else text


def _quote(cell: object) -> object:
    formula = isinstance(cell, str) and re.match(r"[=+\-@\t\r]", cell)  # how one begins
    is_number = formula and re.fullmatch(r"[+-](inf|\d*\.?\d+(e[+-]?\d+)?)", str(cell))
    return f"'{cell}" if formula and not is_number else cell
