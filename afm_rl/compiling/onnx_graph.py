"""Export of a module to ONNX, which runs without torch and this library."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from afm_rl.imports import needs
from afm_rl.progress import waiting

aten = torch.ops.aten


def _choose(which: Tensor, one: Tensor, other: Tensor) -> Tensor:
    if one.dtype != torch.bool or other.dtype != torch.bool:
        return NotImplemented
    return (which & one) | (~which & other)


def _diagonal(matrix: Tensor, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Tensor:
    size, dims = matrix.shape[-1], {dim1 % matrix.dim(), dim2 % matrix.dim()}
    if offset or dims != {matrix.dim() - 2, matrix.dim() - 1} or matrix.shape[-2] != size:
        return NotImplemented
    return torch.where(torch.eye(size, dtype=torch.bool), matrix, 0.0).sum(-1)


def _whole(values: Tensor, nan: float = 0.0, *_: None) -> Tensor:
    most = torch.finfo(values.dtype).max
    return torch.where(values.isnan(), nan or 0.0, values).clamp(-most, most)


# Operations that onnxruntime lacks, and operations that torch's exporter writes with several times
# as many nodes; the time of a tick grows with the number of nodes.
WRITTEN_OTHERWISE: dict[Any, Callable] = {
    aten.copysign.Tensor: lambda size, sign: torch.where(sign < 0, -size.abs(), size.abs()),
    aten.diagonal.default: _diagonal,
    aten.fmax.default: lambda a, b: torch.where((a > b) | b.isnan(), a, b),
    aten.fmin.default: lambda a, b: torch.where((a < b) | b.isnan(), a, b),
    aten.hypot.default: lambda a, b: (a * a + b * b).sqrt(),
    aten.isfinite.default: lambda x: x.abs() < torch.inf,
    aten.lerp.Tensor: lambda a, b, weight: a + weight * (b - a),
    aten.nan_to_num.default: _whole,
    aten.square.default: lambda x: x * x,
    aten.unbind.int: lambda x, dim=0: [x.select(dim, k) for k in range(x.shape[dim])],
    aten.where.self: _choose,
}


def load_runtime() -> Any:
    """Return the package onnxruntime.

    Raises:
        ConfigurationError: if it, or a package that writes graphs, is missing.
    """
    return [needs("ONNX", name, "onnx") for name in ("onnx", "onnxscript", "onnxruntime")][-1]


def as_onnx(
    module: nn.Module,
    inputs: Mapping[str, Tensor],
    outputs: Sequence[str],
    about: Mapping[str, str],
) -> bytes:
    """Return a module as the bytes of an ONNX file.

    Branches (``torch.cond``) become ``If``, which computes one side.

    Args:
        module: a function of tensors.
        inputs: examples of its arguments, by name.
        outputs: names of its results, different from those of inputs.
        about: the file's metadata.

    Raises:
        Exception: of torch or onnxruntime, if an operation has no counterpart.
        RuntimeError: if the outputs of the graph differ from those of the module.
    """
    runtime, given, begun = load_runtime(), tuple(inputs.values()), time.monotonic()
    # A branch is compiled; sizes that differ from the previous branch must stay numbers.
    sizes_are_numbers = torch._dynamo.config.patch(automatic_dynamic_shapes=False)
    with torch.no_grad(), warnings.catch_warnings(), sizes_are_numbers:
        warnings.simplefilter("ignore")
        program = torch.export.export(module, given)
    took = time.monotonic() - begun
    from onnx_ir.passes.common import RemoveUnusedNodesPass
    from onnxscript.optimizer import fold_constants

    decompose = program.run_decompositions  # by the exporter, which otherwise writes more

    def run_decompositions(table: Mapping[Any, Callable]) -> torch.export.ExportedProgram:
        return decompose({**table, **WRITTEN_OTHERWISE})

    with (
        torch.no_grad(),
        warnings.catch_warnings(),
        _quiet(),
        waiting("writing", 1.5 * took),
    ):
        warnings.simplefilter("ignore")
        expected = program.module()(*given)  # the next steps change its constants
        expected = [expected] if isinstance(expected, Tensor) else expected
        program.run_decompositions = run_decompositions  # type: ignore[method-assign]
        made: Any = torch.onnx.export(
            program,
            dynamo=True,
            optimize=False,
            verbose=False,
            input_names=list(inputs),
            output_names=outputs,
        )
        # The simplification visits each node, so first remove the half that is not needed.
        fold_constants(made.model, onnx_shape_inference=False)
        RemoveUnusedNodesPass()(made.model)
        made.optimize()
        RemoveUnusedNodesPass()(made.model)
        for node in made.model.graph.all_nodes():
            node.metadata_props.clear()  # the source lines, most of the file
        made.model.metadata_props.update(about)
        code = made.model_proto.SerializeToString()
    session = runtime.InferenceSession(code, providers=["CPUExecutionProvider"])
    found = session.run(outputs, {name: x.numpy() for name, x in inputs.items()})
    for one, other in zip(map(torch.from_numpy, found), expected, strict=True):
        if not torch.allclose(one, other, rtol=1e-2, atol=1e-2, equal_nan=True):
            raise RuntimeError("the graph says something else")
    return code


@contextmanager
def _quiet() -> Iterator[None]:
    """Hide the exporter's messages about itself."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
