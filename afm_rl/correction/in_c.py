"""The core in C, compiled of the graphs that come with the package."""

from __future__ import annotations

import ctypes
import hashlib
import io
import math
import threading
import tokenize
from collections.abc import Iterator
from functools import cache
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor

from afm_rl.compiling.c_source import as_c, as_header
from afm_rl.compiling.library import library_of
from afm_rl.correction.core import Tick
from afm_rl.imports import needs
from afm_rl.storage.files import write_whole

NAME = "afm_core"
SOURCES = {
    "correction": "achievable belief context_windows core delay experts groups healthy hypotheses "
    "least_squares linear network pairs",
    "spaces": "small_matrices",
}
LAYOUT = tokenize.COMMENT, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.NEWLINE


class CoreInC:
    """The core for ``size`` actuators in C, once it is compiled."""

    def __init__(self, size: int) -> None:
        self.size, graph = size, stored_graph(size)
        self.library = None if graph is None else library_of(graph, NAME)
        self.of_thread = threading.local()

    @property
    def reason(self) -> str:
        """Why there is none; empty: there is, or will be."""
        if self.library is None:
            return f"there is no graph for {self.size} actuators, or not of this source"
        return self.library.reason

    def tick(self, *given: Tensor, wait: bool = False) -> Tick | None:
        """Return the tick of robots ``(*B)``, one after the other; None until it is compiled.

        Args:
            given: memory, newest pair, plan, box and limits, ``(*B, ...)``.
            wait: until it is compiled, if it can be.
        """
        code = None if self.library is None else self.library.load(wait)
        if code is None:
            return None
        memory, *_ = given
        batch, size = memory.shape[:-1], self.size
        taken = [memory.shape[-1:], (3 * size + 2,), (size,), (2, size), (2, size)]
        rows = (x.expand(*batch, *shape) for x, shape in zip(given, taken, strict=True))
        inputs = [numbers.to(torch.float32).contiguous() for numbers in rows]
        shapes = [memory.shape[-1:], (size,), (size,), (size,), (2, size)]
        outputs = [torch.empty((*batch, *shape), dtype=torch.float32) for shape in shapes]
        outputs.append(torch.empty(batch, dtype=torch.bool))
        tensors = *inputs, *outputs, self._workspace(code.workspace)
        places = (ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors)
        code.function(ctypes.c_size_t(math.prod(batch)), *places)
        *numbers, corrects = outputs
        return Tick._make([*(tensor.to(memory.dtype) for tensor in numbers), corrects])

    def _workspace(self, size: int) -> Tensor:
        """Return this thread's own."""
        if not hasattr(self.of_thread, "workspace"):
            self.of_thread.workspace = torch.empty(size, dtype=torch.uint8)
        return self.of_thread.workspace


@cache
def core_in_c(size: int) -> CoreInC:
    """Return the core for ``size`` actuators in C, the same one for all in this process."""
    return CoreInC(size)


def stored_graph(size: int) -> bytes | None:
    """Return the graph for ``size`` actuators; None if there is none, or not of these sources."""
    path = graph_file(size)
    graph = path.read_bytes() if path.is_file() else b""
    return graph if sources().encode() in graph else None


@cache
def sources() -> str:
    """Return a SHA-256 of all that a graph is made of: code without comments, and weights."""
    folder, digest = files("afm_rl"), hashlib.sha256()
    for room, modules in SOURCES.items():
        for name in modules.split():
            text = folder.joinpath(room, f"{name}.py").read_text()
            digest.update("".join(_code(text)).encode())
    digest.update(folder.joinpath("correction", "universal.safetensors").read_bytes())
    return digest.hexdigest()


def _code(text: str) -> Iterator[str]:
    """Return the words of a Python module, less comments and docstrings.

    >>> "".join(_code("one = 1  # the first"))
    'one=1'
    """
    begins = True  # a statement, in which a text alone is a docstring
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in LAYOUT:
            begins = begins or token.type == tokenize.NEWLINE
        elif not (begins and token.type == tokenize.STRING):
            begins = False
            yield token.string


def write_graph(graph: bytes, name: str, path: Path) -> None:
    """Write a graph as ONNX, or as C with a header, by the path's suffix.

    Raises:
        ConfigurationError: without what writes C.
    """
    if path.suffix == ".onnx":
        write_whole(path, graph)
        return
    needs("export", "emx_onnx_cgen", "edge")
    onnx, code = needs("export", "onnx", "edge"), as_c(graph, name)
    about = {pair.key: pair.value for pair in onnx.load_from_string(graph).metadata_props}
    write_whole(path, code.encode())
    write_whole(path.with_suffix(".h"), as_header(code, name, about).encode())


def graph_file(size: int) -> Path:
    """Return where the graph for ``size`` actuators lies."""
    return Path(str(files("afm_rl.correction").joinpath("onnx", f"core_{size}.onnx")))
