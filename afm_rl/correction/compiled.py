"""The tick as machine code: compiled once, kept in the cache, loaded in milliseconds."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from afm_rl._version import __version__


def compile_tick(
    tick: nn.Module, inputs: Sequence[Tensor], cache: str | Path
) -> Callable[..., Sequence[Tensor]] | None:
    """Return a function on tensors as machine code, for any number of missions.

    It is compiled ahead of time (AOTInductor), which takes half a minute of one core, and only if
    the cache does not hold it already for these weights, shapes, and versions.

    Args:
        tick: takes tensors whose first dimension counts missions, returns such tensors.
        inputs: an example, of two missions or more.
        cache: folder of compiled functions.

    Returns:
        The compiled function; None, with a warning, where there is no compiler or it fails.
    """
    path = Path(cache).expanduser() / "compiled" / f"{_digest(tick, inputs)}.pt2"
    try:
        if not path.exists():
            _compile(tick, inputs, path)
        return torch._inductor.aoti_load_package(str(path))
    except Exception as error:  # compilers fail in many ways
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        warnings.warn(f"compile=true: goes on uncompiled: {reason}", stacklevel=2)
        return None


def has_compiler() -> bool:
    """Return whether there is a C++ compiler."""
    return any(shutil.which(name) for name in (os.environ.get("CXX", "c++"), "g++", "clang++"))


def _compile(tick: nn.Module, inputs: Sequence[Tensor], path: Path) -> None:
    if not has_compiler():
        raise RuntimeError("no C++ compiler was found")
    print("compiling the correction, once for this robot (about half a minute)", flush=True)

    class Plain(nn.Module):
        """The tick with a plain tuple: others cannot be exported."""

        def __init__(self) -> None:
            super().__init__()
            self.tick = tick

        def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
            return tuple(self.tick(*given))

    missions = torch.export.Dim("missions", min=1, max=2**20)
    shapes = (tuple({0: missions} for _ in inputs),)
    path.parent.mkdir(parents=True, exist_ok=True)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(Plain(), tuple(inputs), dynamic_shapes=shapes)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            made = torch._inductor.aoti_compile_and_package(
                program, package_path=str(Path(folder) / path.name)
            )
            os.replace(made, path)


def _digest(module: nn.Module, inputs: Sequence[Tensor]) -> str:
    """Return a hash of all that the compiled function depends on."""
    digest = hashlib.sha256()
    shapes = [[str(part.dtype), *part.shape[1:]] for part in inputs]
    settings = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, (bool, int, float, str, list))
    }
    about = [__version__, torch.__version__, shapes, sorted(settings.items())]
    digest.update(json.dumps(about, default=str).encode())
    for part in (*module.parameters(), *module.buffers()):
        digest.update(part.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:32]
