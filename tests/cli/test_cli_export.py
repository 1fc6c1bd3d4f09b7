"""The command ``afm-rl-export``, less the compilation."""

import subprocess
import sys

import pytest
import torch

from afm_rl.cli import export
from afm_rl.correction import export as correction_export
from afm_rl.transforms import controller


@pytest.fixture
def run(monkeypatch, called):
    """Run the command, and return what it would have compiled, its exit status, and its words."""
    made = []

    def export_controller(what, path):
        made.append(what)
        return "c0ffee"

    monkeypatch.setattr(controller, "export_controller", export_controller)

    def call(*arguments):
        done = called(export.main, export.NAME, *arguments)
        return made, done.status, done.out + done.err

    return call


def test_it_exports_planner_and_correction_of_a_method(run, tmp_path):
    out = f"out={tmp_path / 'policy.onnx'}"
    made, status, said = run("method=afm_physics", "planner.candidates=7", out)
    assert status == 0 and "sha256 c0ffee" in said
    assert f"wrote {tmp_path / 'policy.onnx'}: memory, by name, observation (3)" in said
    sizes = made[0].sizes
    assert sizes["noise"] == 7 * 5 * 2 and sizes["goal"] == 2
    given = [torch.zeros(size) for size in sizes.values()]
    assert made[0](made[0].empty(), *given)[1].shape == (2,)


def test_it_exports_the_correction_alone(run, tmp_path):
    made, *_ = run("method=afm_physics", "planner=null", f"out={tmp_path / 'policy.onnx'}")
    assert list(made[0].sizes) == ["observation", "action"]


@pytest.mark.parametrize("more", [[], ["coordinates=4"]])
def test_it_exports_the_core_and_what_asks_a_model(run, tmp_path, monkeypatch, more):
    made = {"tick_graph": b"tick", "search_graph": b"search"}
    for name, code in made.items():
        monkeypatch.setattr(correction_export, name, lambda core, *sizes, code=code: code)
    out = tmp_path / "core.onnx"
    _, status, said = run("actuators=2", *more, f"out={out}")
    assert status == 0 and said.endswith(f"wrote {out}\n")
    assert out.read_bytes() == (b"search" if more else b"tick")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["method=afm_physics"], "out: expected one file"),
        (["method=afm_physics", "out=policy.txt"], "expected a file NAME.onnx"),
        (["method=physics", "out=policy.onnx"], "corrector=none: nothing to export"),
        (["method=online_pe", "corrector=afm", "out=policy.onnx"], "learns during operation"),
        (["actuators=2", "out=core.c"], "not as C; write NAME.onnx, and run it with the C API"),
        (["actuators=two", "out=core.onnx"], "expected actuators=N out=NAME.onnx"),
        (["actuators=2", "out=nowhere/core.onnx"], "in a folder that exists"),
        (["actuators=2", "method=afm", "out=core.onnx"], "expected actuators=N out=NAME.onnx"),
        (["method=afm_physic", "out=policy.onnx"], "Could not find 'method/afm_physic'"),
    ],
)
def test_a_mistake_ends_in_one_line(run, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    made, status, said = run(*arguments)
    assert (made, status) == ([], 2)
    assert said.startswith("afm-rl-export: ") and words in said and said.count("\n") == 1


@pytest.mark.parametrize("name", ["diagnose", "export", "play", "report"])
def test_commands_are_modules_too(name):
    run = [sys.executable, "-m", f"afm_rl.cli.{name}", "--help"]
    said = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    assert f"afm-rl-{name}" in said


def test_without_arguments_it_says_what_it_does(run):
    assert run() == ([], 0, export.ABOUT)
