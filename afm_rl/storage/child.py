"""Files of others, opened in a child process first, which may crash or be ended."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from multiprocessing.spawn import get_executable
from pathlib import Path
from typing import Any

import afm_rl.errors as errors
from afm_rl.errors import AFMError, ConfigurationError, printable

SECONDS = 5.0  # of processor time, because a busy machine must refuse no file
PATIENCE = 60.0  # s until a child that waits is ended
MEMORY = 2 << 30  # bytes beyond those of the imported packages
TOO_LONG = f"opening it takes more than {SECONDS:g} s of processor time"
PROGRAM = """
import sys, types
package = types.ModuleType("afm_rl")  # without its __init__, which imports gymnasium
package.__path__ = [sys.argv[1]]
sys.modules["afm_rl"] = package
from afm_rl.storage.child import main
main()
"""


def in_child(
    said: str,
    function: Callable[..., bytes],
    *args: Any,
    packages: Sequence[str] = (),
    kind: type[AFMError] = ConfigurationError,
) -> bytes:
    """Return what a function returns in a child process with limits of time and memory.

    A crash, endless work, or too much memory inside a C library is an error here. The child may
    take 5 s of processor time, a minute in all, and 2 GiB beyond its packages on systems that
    have such limits (the last: Linux).

    Args:
        said: begins the message of an error.
        function: of a module of this library that does not import torch; the start would take
            seconds.
        args: its arguments, as JSON has them.
        packages: those that it imports, before the limits begin.
        kind: of the error.

    Raises:
        AFMError: what the function raises, or one of ``kind``.

    >>> from afm_rl.dynamics.mjcf import compile_mjcf
    >>> in_child("robot", compile_mjcf, "robot", "<mujoco><body>", packages=["mujoco"])
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: robot: no XML: no element found: line 1, column 14
    """
    names = [function.__module__, function.__name__]
    request = {"names": names, "args": args, "packages": list(packages), "path": sys.path}
    command = [get_executable(), "-P", "-c", PROGRAM, str(Path(errors.__file__).parent)]
    try:
        child = subprocess.run(
            [os.fsdecode(word) for word in command],
            input=json.dumps(request).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            timeout=PATIENCE,
        )
    except subprocess.TimeoutExpired:
        raise kind(f"{said}: opening it takes more than {PATIENCE:g} s") from None
    if child.stdout[:1] == b"+":
        return child.stdout[1:]
    if child.stdout[:1] != b"-":
        raise kind(f"{said}: {_end(child.returncode)}")
    name, text = json.loads(child.stdout[1:])
    raise getattr(errors, name)(text) if name else kind(f"{said}: {text}")


def _end(status: int) -> str:
    """Say how a child ended without an answer.

    >>> _end(-11)
    'the library that opens it is ended by SIGSEGV'
    """
    if status >= 0:
        return f"the library that opens it ends the process with status {status}"
    name = signal.Signals(-status).name
    return TOO_LONG if name == "SIGPROF" else f"the library that opens it is ended by {name}"


def main() -> None:
    """Call the function that the standard input names, in the child."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no part of the answer
    request = json.load(sys.stdin.buffer)
    sys.path += [folder for folder in request["path"] if folder and folder not in sys.path]
    for package in request["packages"]:
        importlib.import_module(package)
    module, name = request["names"]
    function = getattr(importlib.import_module(module), name)
    _limit()
    try:
        answer.write(b"+" + function(*request["args"]))
    except Exception as error:
        answer.write(b"-" + json.dumps(_words(error)).encode())
    answer.close()


def _words(error: Exception) -> tuple[str, str]:
    """Return an error of this library by its name and text, others by their text alone.

    >>> _words(MemoryError())
    ('', 'opening it takes more than 2 GiB of memory')
    """
    if isinstance(error, AFMError):
        return type(error).__name__, str(error)
    line = " ".join(str(error).split()) or type(error).__name__
    out_of_memory = ("allocat", "bad_alloc", "unknown exception")  # the last is MuJoCo's word
    if isinstance(error, MemoryError) or any(word in line for word in out_of_memory):
        line = f"opening it takes more than {MEMORY >> 30} GiB of memory"
    return "", printable(line, 300)


def _limit() -> None:
    """Limit the time and the memory that this process may take from now on."""
    if os.name != "posix":
        return
    import resource

    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # its signal ends the process
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    used = data_size()
    if used is not None:
        limits = [used + MEMORY, *(x for x in (soft, hard) if x != resource.RLIM_INFINITY)]
        resource.setrlimit(resource.RLIMIT_DATA, (min(limits), hard))


def data_size() -> int | None:
    """Return the private memory of this process (bytes); None where the system does not say."""
    try:
        pages = Path("/proc/self/statm").read_text().split()[5]
    except OSError:
        return None
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
