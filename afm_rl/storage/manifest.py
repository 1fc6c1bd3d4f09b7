"""What a folder of results must be: whole, by checksums, and of the settings that are asked for."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from afm_rl._version import __version__
from afm_rl.errors import ArtefactError, refusing
from afm_rl.storage.files import write_whole

MANIFEST, CONFIG, UNFINISHED = "manifest.json", "config.yaml", "unfinished"
MISSIONS, STEPS, COMPUTE = "missions.csv", "steps.parquet", "compute.csv"
JOBS, RECORD = "jobs", "jobs.yaml"
_REMEDY = "restore it, or delete the folder and run the same command again"


def write_manifest(folder: str | Path, names: Iterable[str | Path] | None = None) -> None:
    r"""Write the checksums of the files of a folder to its ``manifest.json``.

    Args:
        folder: where the files are.
        names: the files, absolute or relative to ``folder``; a folder stands for all files in it.
            None: all files, but for hidden ones, and for folders with a manifest of their own.

    Raises:
        ConfigurationError: if the manifest cannot be written.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "missions.csv").write_text("mission,steps\n")
    ...     write_manifest(folder)
    ...     sorted(check_manifest(folder))
    ['missions.csv']
    """
    folder = Path(folder)
    roots = [folder] if names is None else [folder / name for name in names]
    files = {path.relative_to(folder).as_posix() for root in roots for path in _files(root)}
    names = sorted(files - {MANIFEST})
    sums = {name: hashlib.sha256(_bytes(folder / name)).hexdigest() for name in names}
    write_whole(folder / MANIFEST, _text({"version": __version__, "files": sums}).encode())


def extend_manifest(folder: str | Path, names: Iterable[str | Path]) -> None:
    """Add files to a manifest, or renew their checksums.

    Raises:
        ArtefactError: if there is no manifest, or it is damaged.
    """
    write_manifest(folder, [*read_manifest(folder)["files"], *names])


def check_manifest(folder: str | Path) -> dict[str, str]:
    """Return the SHA-256 of every file that the manifest of a folder names, by name.

    Raises:
        ArtefactError: if there is no manifest, or the manifest or a file that it names is damaged
            or missing; the message names the file.
    """
    files = read_manifest(folder)["files"]
    for name, expected in files.items():
        _verified(Path(folder) / name, expected)
    return files


def read_verified(folder: str | Path, name: str) -> bytes:
    r"""Return the content of one file, if the manifest of its folder has its SHA-256.

    Raises:
        ArtefactError: if there is no manifest, the manifest or the file is damaged, or the
            manifest does not name the file.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "missions.csv").write_text("mission,steps\n")
    ...     write_manifest(folder)
    ...     read_verified(folder, "missions.csv")
    b'mission,steps\n'
    """
    path, expected = Path(folder) / name, read_manifest(folder)["files"].get(name)
    if expected is None:
        raise ArtefactError(f"{path}: {MANIFEST} does not name it; {_REMEDY}")
    return _verified(path, expected)


def _verified(path: Path, expected: str) -> bytes:
    data = _bytes(path)
    if hashlib.sha256(data).hexdigest() != expected:
        raise ArtefactError(f"{path}: damaged: its SHA-256 is not the one in {MANIFEST}; {_REMEDY}")
    return data


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """Return ``version`` and ``files`` of a manifest, without looking at the files.

    Raises:
        ArtefactError: if there is none, or it is damaged.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise ArtefactError(f"{path}: no such file; expected the folder of a finished run")
    with refusing(f"{path}: damaged; {_REMEDY}", ArtefactError):
        text = path.read_bytes().decode()
        found = json.loads(text)
        content = {name: found[name] for name in ("version", "files")}
        if text == _text(content) and all(map(_inside, content["files"])):
            return content
    raise ArtefactError(f"{path}: damaged: its checksum does not match; {_REMEDY}")


def _files(root: Path) -> Iterable[Path]:
    if root.is_file():
        yield root
        return
    for path in root.iterdir():
        own = path.is_dir() and (path / MANIFEST).exists()
        if not own and not path.name.startswith("."):
            yield from _files(path)


def _inside(name: str) -> bool:
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts


def _bytes(path: Path) -> bytes:
    with refusing(f"{path}: cannot be read; {_REMEDY}", ArtefactError):
        return path.read_bytes()


def _text(content: Mapping[str, Any]) -> str:
    """Return a manifest's text, with the checksum of what it says."""
    own = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return json.dumps({**content, "sha256": own}, indent=1, sort_keys=True) + "\n"


def influential(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that results depend on, as they come back from JSON or YAML.

    >>> influential({"budget": 5, "progress": True})
    {'budget': 5}
    >>> influential({"device": "cuda:1"})
    {'device': 'cuda'}
    """
    shown = ("progress", "figures", "video", "tensorboard", "tensorboard_every", "diagnosis")
    names = ("label", "compare", "study", "trust")
    done = ("overwrite", "cache", "threads", "core", "checkpoints")
    kept = {name: value for name, value in settings.items() if name not in (*shown, *names, *done)}
    if "device" in kept:  # each kind of device has noise of its own
        kept["device"] = str(kept["device"]).partition(":")[0]
    return json.loads(json.dumps(_without(kept, ("cache", "core"))))


def _without(value: Any, names: tuple[str, ...]) -> Any:
    """Leave out entries of nested mappings."""
    if not isinstance(value, Mapping):
        return value
    return {key: _without(part, names) for key, part in value.items() if key not in names}


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield what nested mappings hold, each with its path; empty ones stay whole.

    >>> list(leaves({"a": {"b": 1, 2: {}}}))
    [(('a', 'b'), 1), (('a', 2), {})]
    """
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from leaves(inner, (*path, key))
    else:
        yield path, dict(value) if isinstance(value, Mapping) else value


def differences(old: Any, new: Any) -> list[str]:
    """Name what differs between two nested mappings, one line for each value.

    >>> differences({"a": {"b": 1, "c": 2}}, {"a": {"b": 3}, "d": None})
    ['a.b: 1 -> 3', 'a.c: 2 -> nothing', 'd: nothing -> None']
    """
    before, after = dict(leaves(old)), dict(leaves(new))
    return [
        f"{'.'.join(map(str, path))}: {before.get(path, 'nothing')} -> {after.get(path, 'nothing')}"
        for path in {**before, **after}
        if path not in before or path not in after or before[path] != after[path]
    ]
