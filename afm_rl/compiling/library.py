"""C code as a library of this machine, compiled once, beside the process that first asks for it.

The process beside it runs ``python -m afm_rl.compiling.library NAME LIBRARY.so < GRAPH.onnx``.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from afm_rl.compiling.c_source import as_c
from afm_rl.errors import warn

FLAGS = ("-std=c11", "-O2", "-march=native", "-fno-math-errno", "-fPIC", "-shared")


class Code(NamedTuple):
    """A function of a library."""

    function: Any
    """Takes the number of robots, and where inputs, outputs and workspace lie."""
    workspace: int
    """Bytes that it needs."""


class Library:
    """The library of an ONNX graph, in a folder of the cache that nobody else may write.

    The folder is ``~/.cache/afm_rl/c``, or ``$AFM_RL_CACHE/c``. A file's name is the digest of all
    that it depends on: graph, generator, compiler, flags and processor.

    Args:
        graph: the bytes of an ONNX file.
        name: of the C function, see :func:`~afm_rl.compiling.c_source.as_c`.
    """

    def __init__(self, graph: bytes, name: str) -> None:
        self.graph, self.name = graph, name
        self.loaded: Code | None = None
        self.process: subprocess.Popen | None = None
        self.reason = ""
        """Why there never will be one; empty: there will."""
        try:
            folder = _private(_cache() / "c")
            about = [version("emx-onnx-cgen"), *_compiler(), *FLAGS, name]
            digest = hashlib.sha256("\0".join(about).encode() + graph).hexdigest()
            self.path = folder / f"{digest[:32]}.so"
        except PackageNotFoundError:
            self.reason = "the package emx-onnx-cgen is missing: pip install 'afm-rl[edge]'"
        except OSError as error:
            self.reason = str(error)

    def load(self, wait: bool = False) -> Code | None:
        """Return the function; None until it is compiled, which begins here.

        Args:
            wait: until it is there, or cannot be had.
        """
        if self.loaded is None and not self.reason:
            if self.process is None and not self.path.exists():
                self.process = self._compile()
            if self.process is not None and self._still_compiling(wait):
                return None
            if not self.reason:
                library = ctypes.CDLL(str(self.path))
                size = ctypes.c_size_t.in_dll(library, f"{self.name}_workspace")
                self.loaded = Code(getattr(library, self.name), size.value)
        return self.loaded

    def _compile(self) -> subprocess.Popen:
        """Begin to compile, with what is left of the processor, even if this process ends."""
        run = [sys.executable, "-m", __name__, self.name, str(self.path)]
        nice = ["nice", "-n", "10"] if shutil.which("nice") else []
        with tempfile.TemporaryFile() as graph:
            graph.write(self.graph)
            graph.seek(0)
            said: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
            return subprocess.Popen([*nice, *run], stdin=graph, start_new_session=True, **said)

    def _still_compiling(self, wait: bool) -> bool:
        process = self.process
        if process is None or not wait and process.poll() is None:
            return True
        _, said = process.communicate()
        self.process = None
        if process.returncode or not self.path.exists():
            lines = said.decode(errors="replace").strip().splitlines() or ["the compiler was ended"]
            self.reason = lines[-1]
            warn(f"core: goes on without C: {self.reason}")
        return False


@cache
def library_of(graph: bytes, name: str) -> Library:
    """Return the library of a graph, the same one for all in this process."""
    return Library(graph, name)


def write_library(graph: bytes, name: str, path: Path) -> None:
    """Write the library of a graph; whole, or not at all."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        source, made = Path(folder) / f"{name}.c", Path(folder) / path.name
        source.write_text(as_c(graph, name))
        run = [_compiler()[0], *FLAGS, "-o", str(made), str(source), "-lm"]
        subprocess.run(run, check=True, stdout=subprocess.DEVNULL)
        made.replace(path)


def _compiler() -> tuple[str, str, str]:
    """Return the C compiler, its version, and the processor for which it compiles.

    Raises:
        FileNotFoundError: if there is none.
    """
    name = next(filter(shutil.which, [os.environ.get("CC", "cc"), "gcc", "clang"]), None)
    if name is None:
        raise FileNotFoundError("no C compiler was found; install one, such as gcc")
    said = subprocess.run([name, "--version"], capture_output=True, text=True, check=False)
    about = Path("/proc/cpuinfo")
    lines = about.read_text().splitlines() if about.exists() else [platform.processor()]
    kinds = {line for line in lines if line.startswith(("model name", "flags", "Features"))}
    return name, said.stdout, platform.machine() + "".join(sorted(kinds))


def _cache() -> Path:
    return Path(os.environ.get("AFM_RL_CACHE", "~/.cache/afm_rl")).expanduser()


def _private(folder: Path) -> Path:
    """Return a folder that this user alone can write, made if it is not there.

    Raises:
        PermissionError: if others can: what lies in it is run.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.stat()
    owner = getattr(os, "getuid", lambda: about.st_uid)()  # Windows has none
    if about.st_uid != owner or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"{folder}: expected a folder that only you may write: chmod 700")
    return folder


if __name__ == "__main__":
    write_library(sys.stdin.buffer.read(), sys.argv[1], Path(sys.argv[2]))
