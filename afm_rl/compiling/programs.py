"""Machine code is a program: written once, kept with its checksum, run only if it is that one."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.progress import waiting
from afm_rl.storage.files import write_whole

OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def checksum_of(code: bytes) -> str:
    """Return the SHA-256 of a program, as ``sha256sum`` prints it.

    >>> checksum_of(b"")[:16]
    'e3b0c44298fc1c14'
    """
    return hashlib.sha256(code).hexdigest()


def loaded(code: bytes) -> Any:
    """Return the function of a program. It may do anything: know first where it comes from."""
    return torch._inductor.aoti_load_package(io.BytesIO(code))


def folder_in(cache: str | Path) -> Path:
    """Return where programs are in a cache."""
    return Path(cache).expanduser() / "compiled"


def recall(path: Path) -> tuple[bytes | None, str]:
    """Return a program that :func:`keep` wrote.

    The bytes that were checked are those that are returned, so that nobody can change them
    in between.

    Args:
        path: the file.

    Returns:
        The program; or None, and why what is there must not run, if anything is there.
    """
    why = _why_not_ours(path.parent)
    if why or not path.exists():
        return None, why
    code, note = path.read_bytes(), path.with_suffix(".sha256")
    if not note.is_file():
        return None, f"{path} has no checksum"
    if note.read_bytes()[:64] != checksum_of(code).encode():
        return None, f"{path} is not what its checksum says"
    return code, ""


def keep(path: Path, code: bytes) -> None:
    """Write a program and its checksum, unless the folder is that of another user."""
    if claim(path.parent):
        write_whole(path, code)
        write_whole(path.with_suffix(".sha256"), f"{checksum_of(code)}  {path.name}\n".encode())


def claim(folder: Path) -> bool:
    """Make a folder into which only this user can write; return whether it is one.

    What it holds is removed if others might have written it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _why_not_ours(folder):
        return True
    if _belongs_to_another(folder):
        return False
    folder.chmod(0o700)
    for part in folder.iterdir():
        if part.is_dir() and not part.is_symlink():
            shutil.rmtree(part)
        else:
            part.unlink()
    return True


def _belongs_to_another(folder: Path) -> bool:
    found = folder.lstat()
    return not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid()


def _why_not_ours(folder: Path) -> str:
    if os.name != "posix" or not folder.exists():  # elsewhere a user's folders are private
        return ""
    if _belongs_to_another(folder):
        return f"{folder} belongs to another user"
    return f"others may write into {folder}" if folder.stat().st_mode & OTHERS_WRITE else ""


class Trace(NamedTuple):
    """A function as a graph, and how long it took to draw it (s)."""

    program: torch.export.ExportedProgram
    took: float


def trace(module: nn.Module, inputs: Sequence[Tensor], shapes: Any = None) -> Trace:
    """Return what a module computes of such inputs.

    Args:
        module: takes and returns tensors.
        inputs: an example.
        shapes: which dimensions may be of any size, as in ``torch.export``.
    """
    begun = time.monotonic()
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(module, tuple(inputs), dynamic_shapes=shapes)
    return Trace(program, time.monotonic() - begun)


def package(
    traced: Trace, settings: Mapping[str, Any], cache: str | Path, times: float = 6.0
) -> bytes:
    """Return a traced function as a program; show how far it is.

    Args:
        traced: the function.
        settings: of the compiler.
        cache: where the compiler keeps what it needs again; torch's own is where others may write.
        times: how much longer than tracing it takes, on a machine that is as busy as then.
    """
    with tempfile.TemporaryDirectory() as made, torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path, scratch = Path(made) / "program.pt2", folder_in(cache) / "torch"
        with (
            _working_in(scratch if claim(scratch) else Path(made)),
            waiting("compiling", times * traced.took),
        ):
            torch._inductor.aoti_compile_and_package(
                traced.program, package_path=str(path), inductor_configs=dict(settings)
            )
        return path.read_bytes()


@contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    name = "TORCHINDUCTOR_CACHE_DIR"
    before = os.environ.get(name)
    os.environ[name] = str(folder)
    try:
        yield
    finally:
        del os.environ[name]
        if before is not None:
            os.environ[name] = before
