"""What an ONNX file of others computes, before it is a policy: the work of a child process."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from afm_rl.errors import ArtefactError, ConfigurationError, printable
from afm_rl.storage.files import read_bounded

LARGEST = 2**27  # bytes of a file, and of the weights in other files
DOMAINS = ("", "ai.onnx", "ai.onnx.ml")  # of operators; all others are somebody's own
MOST = 2**24  # numbers that a policy computes
WORK = 2**31  # products and sums for these, about a second's
SIMPLE = set(  # a step or a few for each number that goes in or comes out
    "Abs Add And ArgMax ArgMin BatchNormalization Cast CastLike Ceil Clip Concat Constant "
    "ConstantOfShape Cos CumSum Div Dropout Elu Equal Erf Exp Expand Flatten Floor Gather "
    "GatherElements GatherND Gelu GlobalAveragePool GlobalMaxPool Greater GreaterOrEqual "
    "HardSigmoid HardSwish Identity InstanceNormalization LayerNormalization LeakyRelu Less "
    "LessOrEqual Log LogSoftmax Max Mean Min Mish Mod Mul Neg Not Or PRelu Pad Pow Range "
    "Reciprocal ReduceL1 ReduceL2 ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum Relu "
    "Reshape Round ScatterElements ScatterND Selu Shape Sigmoid Sign Sin Slice Softmax Softplus "
    "Softsign Split Sqrt Squeeze Sub Sum Tan Tanh Tile Transpose Unsqueeze Where Xor".split()
)

RECURRENT = ("GRU", "LSTM", "RNN")
REAL = (1, 10, 11)  # types of numbers, as a file has them
TYPES = {  # as onnxruntime has them
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
}
NO_POLICY = "no policy that onnxruntime can run"


def read_graph(file: str, inputs: Sequence[str] | None, output: str | None) -> bytes:
    """Return a graph that can be a policy, with its weights, as the bytes of an ONNX file.

    It has computed an action once.

    Args:
        file: its path.
        inputs: names of its inputs; None: it has one.
        output: name of the action; None: the first output.

    Raises:
        ConfigurationError: if there is no such file, input or output.
        ArtefactError: if it holds no such policy.
        Exception: of onnx or onnxruntime.
    """
    path = Path(file)
    model = _model(path)
    outputs = [entry.name for entry in model.graph.output]
    if not model.graph.input or not outputs:
        raise ArtefactError(f"{path}: no inputs, or no outputs; expected both")
    _refuse_state(path, model.graph)
    _fix_inputs(path, model, inputs)
    if output is not None and output not in outputs:
        raise ConfigurationError(f"{path}: output={output!r}: expected one of {_list(outputs)}")
    _check_nodes(path, model)
    code: bytes = model.SerializeToString()
    session = open_session(code)
    session.run(None, {x.name: np.zeros(x.shape, TYPES[x.type]) for x in session.get_inputs()})
    return code


def open_session(code: bytes) -> Any:
    """Return a graph as onnxruntime runs it, on one thread and without remarks."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    return onnxruntime.InferenceSession(code, options, providers=["CPUExecutionProvider"])


def _model(path: Path) -> Any:
    """Return the model of a file, with its weights, if it has nothing but operators and tensors."""
    import onnx

    model = onnx.load_model_from_string(read_bounded(path, LARGEST))
    graph, domains = model.graph, {entry.domain for entry in model.opset_import}
    domains |= {node.domain for node in graph.node}
    if domains := domains - {*DOMAINS} or {function.name for function in model.functions}:
        raise ArtefactError(
            f"{path}: operators of {_list(sorted(domains))}; expected only operators of ONNX"
        )
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g") or attribute.graphs:
                raise ArtefactError(
                    f"{path}: control flow, {printable(node.op_type)}, is not allowed; "
                    "export it without loops and branches"
                )
            if attribute.HasField("sparse_tensor") or attribute.t.external_data:
                raise ArtefactError(f"{path}: a constant that is sparse or in another file")
    if graph.sparse_initializer:
        raise ArtefactError(f"{path}: sparse weights; expected dense weights")
    _read_weights(path, graph.initializer)
    return model


def _read_weights(path: Path, weights: Iterable[Any]) -> None:
    """Read weights that are in other files of the folder."""
    from onnx.external_data_helper import load_external_data_for_tensor, uses_external_data

    folder, left = path.parent.resolve(), LARGEST
    for weight in weights:
        if not uses_external_data(weight):
            continue
        about = {entry.key: entry.value for entry in weight.external_data}
        file = (folder / about.get("location", "")).resolve()
        if not file.is_relative_to(folder) or not file.is_file():
            raise ArtefactError(
                f"{path}: weights in {printable(about.get('location', ''))!r}; expected a file in "
                "its folder"
            )
        left -= int(about.get("length", file.stat().st_size))
        if left < 0:
            raise ArtefactError(f"{path}: more than {LARGEST} bytes of weights")
        load_external_data_for_tensor(weight, str(folder))
        weight.ClearField("external_data")
        weight.data_location = 0


def _fix_inputs(path: Path, model: Any, names: Sequence[str] | None) -> None:
    """Give the inputs the shape of one observation."""
    weights, found = {weight.name for weight in model.graph.initializer}, {}
    for entry in model.graph.input:
        if entry.name in weights:
            continue
        kind, dims = entry.type.tensor_type, entry.type.tensor_type.shape.dim
        if dims and not dims[0].dim_value:
            dims[0].dim_value = 1  # how many observations there are
        shape = [dim.dim_value for dim in dims]
        if not 0 < math.prod(shape) <= MOST or kind.elem_type not in REAL:
            raise ArtefactError(
                f"{path}: input {printable(entry.name)!r} of the shape {shape!s:.80}: expected "
                "real numbers, as many as an observation has"
            )
        found[entry.name] = f"{entry.name} ({math.prod(shape)})"
    if names is None and len(found) == 1:
        return
    if names is None or sorted(names) != sorted(found):
        raise ConfigurationError(
            f"{path}: inputs={names!r}: expected the names of {_list(found.values())}, in the "
            "order in which an observation has their numbers"
        )


def _refuse_state(path: Path, graph: Any) -> None:
    """Refuse a recurrent policy, whose state is handed from step to step."""
    given, made = ({entry.name for entry in ends} for ends in (graph.input, graph.output))
    given -= {weight.name for weight in graph.initializer}
    recurrent = {
        name for node in graph.node if node.op_type in RECURRENT for name in node.input[5:]
    }
    handed_on = {name for name in given if name.endswith("_in") and f"{name[:-2]}out" in made}
    states = sorted(given & recurrent | handed_on)
    if states:
        raise ArtefactError(
            f"{path}: a recurrent policy, whose state {_list(states)} is not kept between steps; "
            "export a policy without memory, such as one that reads the last observations"
        )


def _check_nodes(path: Path, model: Any) -> None:
    """Refuse a graph that computes too much, or nobody knows how much, or divides unsafely."""
    import onnx

    del model.graph.value_info[:]  # what the file says of sizes is no more than a word
    for entry in model.graph.output:
        entry.type.tensor_type.ClearField("shape")
    graph = onnx.shape_inference.infer_shapes(model, strict_mode=True, data_prop=True).graph
    types = {x.name: x.type.tensor_type for x in (*graph.input, *graph.value_info, *graph.output)}
    _check_sizes(path, graph, types)
    _refuse_division(path, graph, types)


def _check_sizes(path: Path, graph: Any, types: dict[str, Any]) -> None:
    """Refuse a graph that computes too many numbers, or too long, or nobody knows how many."""
    shapes = {name: [dim.dim_value for dim in kind.shape.dim] for name, kind in types.items()}
    shapes |= {weight.name: list(weight.dims) for weight in graph.initializer}
    total, works = 0, []
    for node in graph.node:
        for kind in (types.get(name) for name in node.output if name):
            dims = [dim.dim_value for dim in kind.shape.dim] if kind else []
            if kind is None or not kind.HasField("shape") or min(dims, default=1) < 1:
                raise ArtefactError(
                    f"{path}: the size of the output of {printable(node.op_type)} is unknown; "
                    "export it with fixed shapes, for one observation"
                )
            total += math.prod(dims)
        ends = [[shapes.get(name, []) for name in names] for names in (node.input, node.output)]
        works.append((_work(node, *ends), printable(node.op_type)))
    if total > MOST:
        raise ArtefactError(f"{path}: {total} numbers to compute, more than {MOST}")
    if (work := sum(each for each, _ in works)) > WORK:
        raise ArtefactError(
            f"{path}: {work:.2g} products and sums to compute, most of them by {max(works)[1]}; "
            f"expected at most {WORK:.2g}"
        )


def _refuse_division(path: Path, graph: Any, types: dict[str, Any]) -> None:
    """Refuse to divide whole numbers of an observation: -2^31 / -1, and x / 0, end the process.

    Where they do not depend on an observation, the first run shows it.
    """
    observed = {entry.name for entry in graph.input}
    observed -= {weight.name for weight in graph.initializer}
    for node in graph.node:
        if node.op_type in ("Shape", "Size") or observed.isdisjoint(node.input):
            continue
        observed.update(filter(None, node.output))
        if node.op_type in ("Div", "Mod") and types[node.output[0]].elem_type not in REAL:
            raise ArtefactError(
                f"{path}: {node.op_type} of integers that depend on the observation can "
                "crash the process; export the policy with real numbers"
            )


def _work(node: Any, given: list[list[int]], made: list[list[int]]) -> int:
    """Return at most how many products and sums a node takes, by the shapes of what it is given."""
    numbers, results = sum(map(math.prod, given)), sum(map(math.prod, made))
    kind, weight = node.op_type, math.prod(given[1]) if len(given) > 1 else 1
    if kind in SIMPLE:
        return numbers + results
    if kind in ("MatMul", "Gemm"):
        return results * max(given[0], default=1)
    if kind in ("Conv", "ConvTranspose"):
        return max(results, math.prod(given[0])) * (weight // given[1][0])
    if kind in RECURRENT:
        return math.prod(given[0][:2]) * numbers
    if kind in ("AveragePool", "MaxPool"):
        (kernel,) = (each.ints for each in node.attribute if each.name == "kernel_shape")
        return results * math.prod(kernel)
    return (numbers + results) ** max(2, len(given))  # whatever it does with them


def _list(names: Iterable[str]) -> str:
    return ", ".join(printable(name) for name in list(names)[:8])
