"""Foreign files that crash a library, or keep it busy, end with one line and exit status 2."""

import os
import random
import re
import resource
import time

import numpy as np
import pandas as pd
import pytest
import torch
from harness import mutated

from afm_rl.cli import diagnose, play
from afm_rl.dynamics import MuJoCoDynamics
from afm_rl.errors import AFMError
from afm_rl.planning import policy_from_onnx
from afm_rl.planning.onnx_file import NO_POLICY
from afm_rl.storage.child import in_child

pytestmark = pytest.mark.check
pytest.importorskip("mujoco")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
FLOAT, INT32, INT64 = 1, 6, 7
BODY = """<worldbody><body name="b"><joint name="x" type="hinge"/><geom size=".1"/>{}</body>
</worldbody><actuator><motor joint="x" ctrlrange="-1 1"/></actuator>
<sensor><jointpos joint="x"/></sensor></mujoco>"""


def policy(folder, nodes, weights):
    """Write a graph of four observations."""
    ends = [[onnx.helper.make_tensor_value_info(*end)] for end in (("x", 1, [1, 4]), ("y", 1, []))]
    nodes = [onnx.helper.make_node(*node[:3], **dict(node[3:])) for node in nodes]
    tensors = [onnx.numpy_helper.from_array(value, name) for name, value in weights.items()]
    opsets = [onnx.helper.make_opsetid("", 17)]
    graph = onnx.helper.make_graph(nodes, "g", *ends, tensors)
    model = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8)
    (folder / "policy.onnx").write_bytes(model.SerializeToString())
    return folder / "policy.onnx"


def overflow(folder):
    """Divide -2^31 by -1."""
    cast = "Cast", ["d"], ["f"], ("to", FLOAT)
    nodes = [("Div", ["a", "b"], ["d"]), cast, ("Add", ["x", "f"], ["y"])]
    return policy(folder, nodes, {"a": np.int32([-(2**31)]), "b": np.int32([-1])})


def endless(folder):
    """Let the reader of an equation wait for letters that do not come."""
    return policy(folder, [("Einsum", ["x"], ["y"], ("equation", "....ij->...."))], {})


def index(folder):
    """Take the place that an observation says."""
    nodes = [("Cast", ["x"], ["i"], ("to", INT64)), ("Gather", ["w", "i"], ["y"])]
    return policy(folder, nodes, {"w": np.zeros(4, np.float32)})


def body(head="", inside=""):
    """Return an MJCF that is written into a folder."""

    def write(folder):
        path = folder / "body.xml"
        path.write_text(f"<mujoco>{head}{BODY.format(inside)}")
        return path

    return write


ITSELF = "<asset><model name='s' file='body.xml'/></asset>", "<attach model='s' prefix='p'/>"
NUMBERS = "<geom size='.1' user='{}'/>".format("1 " * 30000)
GRID = '<flexcomp type="grid" count="3000 3000 1" spacing=".1 .1 .1" name="f" dim="2"/>'
MEMORY = "opening it takes more than 2 GiB of memory"
MJCF = {
    "a model that attaches itself": (body(*ITSELF), "the library .* is ended by SIGSEGV"),
    "an arena": (body('<size memory="8G"/>'), MEMORY),
}
LARGE = {
    "numbers of sensors": (body('<size nuser_sensor="500000000"/>'), MEMORY),
    "a grid": (body("", GRID), "9000010 elements"),
    "numbers of an element": (
        body("", f"<replicate count='50000' euler='0 0 1'>{NUMBERS}</replicate>"),
        "opening it takes more than (5 s of processor time|2 GiB)",
    ),
}
ONNX = {
    "a division": (overflow, "the library that opens it is ended by SIGFPE"),
    "an equation": (endless, "opening it takes more than 5 s of processor time"),
}


def children():
    """Return the processor time (s) of the child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def end_of(call, *args):
    """Return the one line with which a call ends, in time."""
    start = children()
    with pytest.raises(AFMError) as error:
        call(*args)
    assert children() - start < 10  # s
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    "name", [*MJCF, *(pytest.param(name, marks=pytest.mark.slow) for name in LARGE)]
)
def test_an_mjcf_does_not_end_the_process(tmp_path, name):
    write, words = (MJCF | LARGE)[name]
    path = write(tmp_path)
    line = end_of(MuJoCoDynamics, path)
    assert line.startswith(f"dynamics.model={str(path)[:80]!r}: ") and re.search(words, line)


@pytest.mark.slow
@pytest.mark.parametrize("name", ONNX)
def test_a_graph_does_not_end_the_process(tmp_path, name):
    write, words = ONNX[name]
    path = write(tmp_path)
    assert end_of(policy_from_onnx, path) == f"{path}: {NO_POLICY}: {words}"


def test_a_step_that_fails_names_the_file(tmp_path):
    path = index(tmp_path)
    acting = policy_from_onnx(path)
    assert acting(torch.tensor([1.0, 3.0, 0.0, 0.0])).tolist() == [0.0] * 4
    line = end_of(acting, torch.tensor([1.0, 9.0, 0.0, 0.0]))
    assert line.startswith(f"{path}: no action for this observation: ") and "idx=9" in line


def test_a_log_of_tiny_time_steps_ends_in_one_line(tmp_path, called):
    rows = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    table = pd.DataFrame(rows, columns=["command.x", "response.x"])
    table.assign(t=5e-302 * np.arange(30)).to_csv(tmp_path / "log.csv", index=False)
    end = called(diagnose.main, "afm-rl-diagnose", tmp_path / "log.csv")
    assert (end.status, end.out, end.err.count("\n")) == (2, "", 1)
    assert "log.csv: t has time steps of 5e-302 s: expected" in end.err


def test_commands_end_with_status_2(tmp_path, called):
    rows = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    names = "action.x", "state.q_x", "state.v_x"
    pd.DataFrame(dict(zip(names, rows.T, strict=True))).to_csv(tmp_path / "log.csv")
    model = body(*ITSELF)(tmp_path)
    ends = [
        called(diagnose.main, "afm-rl-diagnose", tmp_path / "log.csv", "--model", model),
        called(play.main, "afm-rl-play", "--robot", "hopper", "--policy", overflow(tmp_path)),
    ]
    for end, signal in zip(ends, ("SIGSEGV", "SIGFPE"), strict=True):
        assert (end.status, end.out, end.err.count("\n")) == (2, "", 1)
        assert f"is ended by {signal}" in end.err


@pytest.mark.slow
def test_60_damaged_files_are_read_or_refused(tmp_path):
    rng, sound = random.Random(1), body()(tmp_path).read_bytes()
    path = tmp_path / "damaged.xml"
    for _ in range(60):
        path.write_bytes(mutated(sound, rng))
        try:
            assert MuJoCoDynamics(path).names[1]
        except AFMError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("function", "argument", "words"),
    [
        (bytes, 3 << 30, MEMORY),
        (os._exit, 3, "the library that opens it ends the process with status 3"),
        (int, "one", "invalid literal for int() with base 10: 'one'"),
    ],
)
def test_a_child_ends_in_one_line(function, argument, words):
    assert end_of(in_child, "file", function, argument) == f"file: {words}"


def test_a_child_that_waits_is_ended(monkeypatch):
    monkeypatch.setattr("afm_rl.storage.child.PATIENCE", 2.0)
    assert end_of(in_child, "file", time.sleep, 60) == "file: opening it takes more than 2 s"


def test_a_child_is_quick_and_starts_as_its_parent_was_started(monkeypatch, tmp_path):
    (tmp_path / "json.py").write_text("raise SystemExit(9)")  # in the working directory
    monkeypatch.chdir(tmp_path)
    start = children()
    assert in_child("file", bytes, 3) == bytes(3)
    assert children() - start < 1.5  # s; torch alone takes longer to import
