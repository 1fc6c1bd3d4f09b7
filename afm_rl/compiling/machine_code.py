"""Modules as machine code: compiled once, kept in the cache, run only if they are what was kept."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from afm_rl._version import __version__
from afm_rl.progress import waiting
from afm_rl.storage.signed import read_signed, write_signed

PLANS = 3  # tensors with more dimensions are plans
LONGEST = 900  # seconds that a process may compile


def checksum_of(code: bytes) -> str:
    """Return the SHA-256 of a program, as ``sha256sum`` prints it.

    >>> checksum_of(b"")[:16]
    'e3b0c44298fc1c14'
    """
    return hashlib.sha256(code).hexdigest()


def loaded(code: bytes) -> Any:
    """Return the function of a program. It may do anything: know first where it comes from."""
    return torch._inductor.aoti_load_package(io.BytesIO(code))


class Trace(NamedTuple):
    """A function as a graph, and how long it took to draw it (s)."""

    program: torch.export.ExportedProgram
    took: float


def trace(module: nn.Module, inputs: Sequence[Tensor], shapes: Any = None) -> Trace:
    """Return what a module computes of such inputs."""
    begun = time.monotonic()
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(module, tuple(inputs), dynamic_shapes=shapes)
    return Trace(program, time.monotonic() - begun)


def package(traced: Trace, settings: Mapping[str, Any], times: float = 6.0) -> bytes:
    """Return a traced function as a program; show how far it is."""
    with tempfile.TemporaryDirectory() as made, torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(made) / "program.pt2"
        with _working_in(Path(made)), waiting("compiling", times * traced.took):
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


class MachineCode:
    """Methods of a module as machine code, each compiled when it is first called."""

    def __init__(self, owner: nn.Module, cache: str | Path) -> None:
        self.owner, self.cache = owner, cache
        self.codes: dict[tuple, Callable[..., Sequence[Tensor]]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"codes": {}}  # loaded code cannot be copied

    def __call__(
        self, function: Callable, *given: Tensor, model: nn.Module | None = None
    ) -> list[Tensor]:
        """Return what a method makes of tensors ``(*B, ...)``, or its plain form if it must be."""
        like = given[0]
        key = (function.__name__, model, like.dtype, like.device, like.shape[-1])
        code = self.codes.get(key)
        if code is None:
            code = Method(self.owner, function, model)
            two = [part.reshape(-1, *part.shape[like.dim() - 1 :])[:1] for part in given]
            two = [part.repeat(2, *[1] * (part.dim() - 1)) for part in two]
            if like.is_cpu:  # machine code is for the processor
                code = compile_module(code, two, self.cache, traced=model is not None) or code
            self.codes[key] = code
        if isinstance(code, Beside):
            code = self.codes[key] = code.finished()
        return in_one_batch(code, *(part.contiguous() for part in given))  # as it was compiled for


class Method(nn.Module):
    """A method on tensors as a module of its own."""

    function: Callable[..., Any]

    def __init__(self, owner: nn.Module, function: Callable, more: nn.Module | None) -> None:
        super().__init__()
        self.owner, self.more, self.name = owner, more, function.__qualname__
        self.__dict__["function"] = function

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """Return what the method returns, as a tuple."""
        more = [] if self.more is None else [self.more]
        found = self.function(self.owner, *given, *more)
        return (found,) if isinstance(found, Tensor) else tuple(found)


def in_one_batch(function: Callable[..., Sequence[Tensor]], *given: Tensor) -> list[Tensor]:
    """Return what a function of tensors ``(B, ...)`` makes of tensors ``(*B, ...)``.

    >>> in_one_batch(lambda x: [x.sum(-1)], torch.ones(2, 3, 4))[0].shape  # a sum of four numbers
    torch.Size([2, 3])
    """
    batch = given[0].shape[:-1]
    lead = len(batch)
    if lead == 0:
        given = tuple(part.unsqueeze(0) for part in given)
    elif lead > 1:
        given = tuple(part.flatten(0, lead - 1) for part in given)
    return [part.view((*batch, *part.shape[1:])) for part in function(*given)]


class Beside:
    """A module that runs as it is until a process beside this one has compiled it.

    That goes on when this process ends, so that the next one finds what it made.

    Args:
        module: takes tensors, returns a tuple of tensors.
        path: file that is written, and run from then on.
        work: writes it.
    """

    processes: ClassVar[dict[Path, tuple[int, int]]] = {}

    def __init__(self, module: nn.Module, path: Path, work: Callable[[], None]) -> None:
        self.module, self.path = module, path
        if path not in Beside.processes:
            Beside.processes[path] = _begin(work)

    def __call__(self, *given: Tensor) -> Sequence[Tensor]:
        return self.module(*given)

    def finished(self, wait: bool = False) -> Callable[..., Sequence[Tensor]]:
        """Return the machine code if it is there, else this; the module if it never will be."""
        reason = ""
        if self.path in Beside.processes:
            process, end = Beside.processes[self.path]
            if not _ended(process, wait):
                return self
            with open(end, "rb") as reasons:
                reason = reasons.read().decode()
            del Beside.processes[self.path]
        code = read_signed(self.path)
        if code is None:
            _warn(reason or "the process that compiled was ended")
        return self.module if code is None else runner(code)


def finish_compiling() -> None:
    """Wait for all processes that compile beside this one."""
    for process, _ in Beside.processes.values():
        _ended(process, wait=True)


def _ended(process: int, wait: bool) -> bool:
    try:
        return os.waitpid(process, 0 if wait else os.WNOHANG)[0] != 0
    except ChildProcessError:  # it was waited for before
        return True


def _begin(work: Callable[[], None]) -> tuple[int, int]:
    """Do work in another process; return its number, and where to read why it failed."""
    end, start = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of threads, none of which the work needs
        process = os.fork()
    if process:
        os.close(start)
        return process, end
    try:
        signal.alarm(LONGEST)
        os.nice(10)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):  # nobody shall wait for an end of these
            os.dup2(nowhere, stream)
        torch.set_num_threads(1)
        work()
    except BaseException as error:  # compilers fail in many ways
        os.write(start, _reason(error).encode())
    finally:
        os._exit(0)


def compile_module(
    module: nn.Module, inputs: Sequence[Tensor], cache: str | Path, traced: bool
) -> Callable[..., Sequence[Tensor]] | None:
    """Return a module as machine code, for any number of missions.

    It is compiled ahead of time (AOTInductor), which takes half a minute of one core or more, and
    only if the cache does not hold it already for these weights, shapes, settings and versions,
    with this user's signature; a line says so if it does not run what is there. On Linux a process
    beside this one compiles, and the module runs as it is meanwhile (:class:`Beside`).

    Args:
        module: takes tensors whose first dimension counts missions, returns a tuple of such.
        inputs: an example, of two missions or more.
        cache: folder of compiled functions.
        traced: whether it holds functions that are not ours: then what it computes is looked at
            each time, which takes a second, before it is taken from the cache.

    Returns:
        The compiled function; None, with a warning, where there is no compiler or it fails.
    """
    try:
        drawn = _trace(module, inputs) if traced else None
        name = f"{_digest(module, inputs, drawn and drawn.program)}.pt2"
        path = Path(cache).expanduser() / "compiled" / name
        code = read_signed(path)
        if code is not None:
            return runner(code)
        found = f"{path} was not written by you" if path.exists() else "nothing compiled yet"
        print(f"{found}: compiling anew", flush=True)
        if not has_compiler():
            raise RuntimeError("no C++ compiler was found")

        def work() -> None:
            write_signed(path, _compile(module, inputs, drawn))

        if sys.platform == "linux":
            return Beside(module, path, work)
        work()
        return runner(read_signed(path) or b"")
    except Exception as error:  # compilers fail in many ways
        _warn(_reason(error))
        return None


def runner(code: bytes) -> Callable[..., Sequence[Tensor]]:
    """Return the function of a program that returns as many tensors as it does."""
    # What is loaded could be called, but would read its description anew each time.
    run = loaded(code).loader.boxed_run
    return lambda *given: run(list(given))


def _reason(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _warn(reason: str) -> None:
    warnings.warn(f"compile=true: goes on uncompiled: {reason}", stacklevel=3)


def has_compiler() -> bool:
    """Return whether there is a C++ compiler."""
    return any(shutil.which(name) for name in (os.environ.get("CXX", "c++"), "g++", "clang++"))


def _trace(module: nn.Module, inputs: Sequence[Tensor]) -> Trace:
    missions = torch.export.Dim("missions", min=1, max=2**20)
    return trace(module, inputs, (tuple({0: missions} for _ in inputs),))


def _compile(module: nn.Module, inputs: Sequence[Tensor], traced: Trace | None) -> bytes:
    code = package(traced or _trace(module, inputs), settings_for(inputs))
    with torch.no_grad():
        for one, other in zip(loaded(code)(*inputs), module(*inputs), strict=True):
            if not torch.allclose(one, other, rtol=1e-2, atol=1e-2, equal_nan=True):
                raise RuntimeError("the compiled function says something else")
    return code


def settings_for(inputs: Sequence[Tensor]) -> dict[str, Any]:
    """Return how the compiler is set: with vector instructions for whole plans alone.

    Elsewhere they gain nothing, and to find out where they could takes a third of the time. With
    them, torch 2.13 compiles softmaxes and maxima over axes of size one wrongly, as for robots with
    one action.
    """
    plans = any(part.dim() > PLANS for part in inputs)
    return {} if plans and all(part.shape[-1] > 1 for part in inputs) else {"cpp.simdlen": 1}


def _digest(
    module: nn.Module, inputs: Sequence[Tensor], program: torch.export.ExportedProgram | None
) -> str:
    """Return a hash of all that the compiled function depends on."""
    digest = hashlib.sha256()
    shapes = [[str(part.dtype), *part.shape[1:]] for part in inputs]
    settings = [
        (type(part).__name__, name, value)
        for part in module.modules()
        for name, value in sorted(vars(part).items())
        if isinstance(value, (bool, int, float, str, list))
    ]
    code = None if program is None else program.graph_module.code
    about = [__version__, torch.__version__, settings_for(inputs), shapes, settings, code]
    digest.update(json.dumps(about, default=str).encode())
    constants = [] if program is None else program.constants.values()
    for part in (*module.parameters(), *module.buffers(), *constants):
        digest.update(part.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:32]
