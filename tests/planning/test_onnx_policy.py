"""Policies that others exported as ONNX: what they say, and what is refused."""

import random
import tracemalloc

import numpy as np
import pytest
import torch
from harness import mutated

from afm_rl.errors import ArtefactError, ConfigurationError, refusing
from afm_rl.planning import policy_from_onnx
from afm_rl.planning.onnx_file import NO_POLICY, read_graph
from afm_rl.play import make_robot

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
helper, FLOAT = onnx.helper, onnx.TensorProto.FLOAT
WEIGHT = np.arange(6, dtype=np.float32).reshape(3, 2) / 10


def entry(name, shape, kind=FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def graph(nodes, weights=(), inputs=(("obs", [1, 3]),), outputs=(("act", [1, 2]),), **model):
    """Return a model of such nodes."""
    tensors = [onnx.numpy_helper.from_array(np.asarray(x), name) for name, x in weights]
    entries = [[entry(name, shape) for name, shape in ends] for ends in (inputs, outputs)]
    made = helper.make_graph(nodes, "policy", *entries, tensors)
    opsets = [helper.make_opsetid(domain, 18) for domain in model.pop("domains", [""])]
    return helper.make_model(made, opset_imports=opsets, ir_version=9, **model)


def node(kind, *names, **settings):
    """Return a node; the last name is its output."""
    return helper.make_node(kind, names[:-1], names[-1:], **settings)


def layer(inputs=(("obs", [1, 3]),)):
    """Return tanh(x W), of one input or more behind one another."""
    joined = node("Concat", *(name for name, _ in inputs), "x", axis=-1)
    nodes = [joined, node("MatMul", "x", "W", "y"), node("Tanh", "y", "act")]
    return graph(nodes, [("W", WEIGHT)], inputs)


def saved(tmp_path, model):
    path = tmp_path / "policy.onnx"
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize("batch", [1, "batch"])
def test_a_policy_acts_on_rows_of_observations(tmp_path, batch):
    policy = policy_from_onnx(saved(tmp_path, layer([("obs", [batch, 3])])))
    assert (policy.observation_size, policy.action_size) == (3, 2)
    seen = torch.randn(4, 5, 3, dtype=torch.float64)
    expected = (seen @ torch.from_numpy(WEIGHT).double()).tanh()
    torch.testing.assert_close(policy(seen), expected, atol=1e-6, rtol=0)
    assert torch.equal(policy(seen[0, 0]), policy(seen)[0, 0])


def test_several_inputs_are_named_in_the_order_of_the_observation(tmp_path):
    path = saved(tmp_path, layer([("command", [1, 1]), ("body", [1, 2])]))
    policy, seen = policy_from_onnx(path, inputs=["body", "command"]), torch.tensor([1.0, 2.0, 3.0])
    expected = (seen[[2, 0, 1]] @ torch.from_numpy(WEIGHT)).tanh()
    torch.testing.assert_close(policy(seen), expected)
    for names in (None, ["body"], ["body", "goal"]):
        with pytest.raises(ConfigurationError, match=r"names of command \(1\), body \(2\), in the"):
            policy_from_onnx(path, names)
    with pytest.raises(ConfigurationError, match="output='value': expected one of act"):
        policy_from_onnx(path, ["body", "command"], "value")


def elsewhere(model, location):
    """Put the weights into another file."""
    (weight,) = model.graph.initializer
    weight.ClearField("raw_data")
    weight.data_location = onnx.TensorProto.EXTERNAL
    weight.external_data.add(key="location", value=location)
    return model


def test_weights_may_be_in_another_file_of_the_folder(tmp_path):
    (tmp_path / "weights").write_bytes(WEIGHT.tobytes())
    policy = policy_from_onnx(saved(tmp_path, elsewhere(layer(), "weights")))
    assert policy(torch.ones(3)).shape == (2,)


def forever():
    body = helper.make_graph(
        [node("Identity", "go", "on"), node("Identity", "x", "y")],
        "body",
        [entry("i", [], 7), entry("go", [], 9), entry("x", [1, 3])],
        [entry("on", [], 9), entry("y", [1, 3])],
    )
    return graph([node("Loop", "", "true", "obs", "act", body=body)], [("true", np.array(True))])


def large(*shape):
    """Return a graph that makes ever so many numbers of a few bytes, and declares none of it."""
    nodes = [node("ConstantOfShape", "shape", "x"), node("ReduceSum", "x", "y", keepdims=0)]
    made = graph([*nodes, node("Add", "obs", "y", "act")], [("shape", np.array(shape))])
    made.graph.value_info.append(entry("x", [1]))
    return made


def doubling():
    nodes = [node("Concat", *[f"x{k}"] * 8, f"x{k + 1}", axis=0) for k in range(9)]
    return graph([node("Identity", "obs", "x0"), *nodes, node("Identity", "x9", "act")])


def minutes(kind):
    """Return a graph of a few hundred bytes that works for minutes, and returns little."""
    nodes = [node("ConstantOfShape", name, f"zeros {name}") for name in ("image", "kernel")]
    image, kernel = "zeros image", "zeros kernel"
    names = {"Einsum": [image, kernel, image], "MatMul": [image, image], "MaxPool": [image]}
    about = {"Einsum": {"equation": "abij,cdkl,efmn->"}}.get(kind, {})
    settings = {"MaxPool": {"kernel_shape": [1023, 1023], "pads": [511] * 4}}.get(kind, about)
    nodes.append(node(kind, *names.get(kind, [image, kernel]), "x", **settings))
    nodes += [node("ReduceSum", "x", "y", keepdims=0), node("Add", "obs", "y", "act")]
    side = 100 if kind == "Einsum" else 1000
    shapes = {"image": [1, 1, 2 * side, 2 * side], "kernel": [1, 1, side, side]}
    return graph(nodes, [(name, np.array(shape)) for name, shape in shapes.items()])


def recurrent(kind="GRU", state="h_in", after="h_out"):
    """Return a recurrent policy, as robots' simulators export them."""
    gates = {"GRU": 3, "LSTM": 4}[kind]
    weights = [(name, np.zeros((1, 2 * gates, n), np.float32)) for name, n in (("W", 3), ("R", 2))]
    cell = helper.make_node(kind, ["x", "W", "R", "", "", state], ["y", after], hidden_size=2)
    nodes = [node("Unsqueeze", "obs", "zero", "x"), cell, node("Squeeze", "y", "zero one", "act")]
    axes = [("zero", np.array([0])), ("zero one", np.array([0, 1]))]
    ends = [("obs", [1, 3]), (state, [1, 1, 2])], [("act", [1, 2]), (after, [1, 1, 2])]
    return graph(nodes, [*weights, *axes], *ends)


def carried():
    """Return a policy that hands a state on, without a cell that is known as recurrent."""
    ends = [("obs", [1, 3]), ("h_in", [1, 3])], [("act", [1, 3]), ("h_out", [1, 3])]
    return graph([node("Add", "obs", "h_in", "act"), node("Tanh", "act", "h_out")], (), *ends)


def quotient():
    """Return a policy that divides by a whole number of the observation, which may be 0."""
    nodes = [node("Cast", "obs", "n", to=6), node("Div", "n", "n", "q")]
    return graph([*nodes, node("Cast", "q", "act", to=FLOAT)])


def read(path):
    """Do what the child process of a policy does in this one."""
    with refusing(f"{path}: {NO_POLICY}", ArtefactError):
        return read_graph(str(path), None, None)


REFUSED = {
    "a state without a cell": (carried, "a recurrent policy, whose state h_in"),
    "a state": (recurrent, "a recurrent policy, whose state h_in is not kept"),
    "a state of any name": (lambda: recurrent("LSTM", "memory", "later"), "whose state memory"),
    "a long convolution": (
        lambda: minutes("Conv"),
        "4e+12 products and sums to compute, most of them by Conv",
    ),
    "a long product": (lambda: minutes("MatMul"), "8e+09 products and sums"),
    "a long maximum": (lambda: minutes("MaxPool"), "most of them by MaxPool"),
    "a long sum": (lambda: minutes("Einsum"), "most of them by Einsum"),
    "a loop": (forever, "control flow, Loop"),
    "an operator of somebody's own": (
        lambda: graph([node("Harm", "obs", "act", domain="mine")], domains=["", "mine"]),
        "operators of mine; expected only operators of ONNX",
    ),
    "weights anywhere": (
        lambda: elsewhere(layer(), "/etc/passwd"),
        "expected a file in its folder",
    ),
    "weights above": (lambda: elsewhere(layer(), "../policy"), "expected a file in its folder"),
    "weights by a link": (lambda: elsewhere(layer(), "link"), "expected a file in its folder"),
    "too many numbers": (lambda: large(2**20, 2**20), "numbers to compute, more than"),
    "ever more of them": (doubling, "numbers to compute, more than"),
    "an unknown number": (
        lambda: graph([node("NonZero", "obs", "x"), node("Cast", "x", "act", to=FLOAT)]),
        "size of the output of NonZero",
    ),
    "a quotient of whole numbers": (
        quotient,
        "Div of integers that depend on the observation",
    ),
    "words": (
        lambda: graph([node("Identity", "obs", "act")], inputs=[("obs", [1, "n"])]),
        "expected real numbers, as many as an observation has",
    ),
    "shapes that do not fit": (
        lambda: graph([node("MatMul", "obs", "W", "act")], [("W", WEIGHT.T)]),
        "no policy that onnxruntime can run",
    ),
    "nothing": (onnx.ModelProto, "no inputs, or no outputs"),
    "an unknown operator": (
        lambda: graph([node("Harm", "obs", "act")]),
        "size of the output of Harm",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_more_than_tensors_is_refused_in_one_line(tmp_path, name):
    (tmp_path / "link").symlink_to("/etc/hostname")
    make, words = REFUSED[name]
    path = saved(tmp_path, make())
    tracemalloc.start()
    with pytest.raises(ArtefactError) as refused:
        read(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    message = str(refused.value)
    assert message.startswith(f"{path}: ") and words in message and "\n" not in message
    assert most < 10**8


def test_300_damaged_files_are_read_or_refused(tmp_path):
    rng, sound, sound_still = random.Random(0), layer().SerializeToString(), 0
    path = tmp_path / "policy.onnx"
    for _ in range(300):
        path.write_bytes(mutated(sound, rng))
        try:
            sound_still += len(read(path)) > 0
        except (ArtefactError, ConfigurationError) as error:
            assert "\n" not in str(error)
    assert sound_still < 150
    with pytest.raises(ConfigurationError, match="no such file"):
        policy_from_onnx(tmp_path / "nothing.onnx")


def test_the_page_plays_it_in_the_robot_that_is_named(tmp_path):
    pytest.importorskip("mujoco")
    path = saved(tmp_path, layer())
    with pytest.raises(ConfigurationError, match="name the robot"):
        make_robot(file=path)
    with pytest.raises(ConfigurationError, match=r"3 observations and 2 actions; pendulum has \(3"):
        make_robot("pendulum", path)
    nodes = [node("MatMul", "obs", "W", "act")]
    path = saved(tmp_path, graph(nodes, [("W", WEIGHT[:, :1])], outputs=[("act", [1, 1])]))
    robot = make_robot("pendulum", path)
    assert robot.policy()(np.ones(3)).shape == (1,)
