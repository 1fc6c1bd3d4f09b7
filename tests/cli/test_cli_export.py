"""The command ``afm-rl-export``, less the compilation."""

import sys

import pytest
import torch

from afm_rl.cli import export
from afm_rl.transforms import controller


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command, and return what it would have compiled, its exit status, and its words."""
    made = []
    monkeypatch.setattr(controller, "has_compiler", lambda: True)

    def export_controller(what, path):
        made.append(what)
        return "c0ffee"

    monkeypatch.setattr(controller, "export_controller", export_controller)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", [export.NAME, *map(str, arguments)])
        status = 0
        try:
            export.main()
        except SystemExit as error:
            status = error.code
        return made, status, "".join(capsys.readouterr())

    return call


def test_it_exports_planner_and_correction_of_a_method(run, tmp_path):
    out = f"out={tmp_path / 'policy.pt2'}"
    made, status, said = run("method=afm_physics", "planner.population=7", out)
    assert status == 0 and f"wrote {tmp_path / 'policy.pt2'}: memory (" in said
    assert "sha256 c0ffee" in said
    sizes = made[0].sizes
    assert sizes["noise"] == 7 * 5 * 2 and sizes["goal"] == 2
    given = [torch.zeros(size) for size in sizes.values()]
    assert made[0](*given)[1].shape == (2,)


def test_it_exports_the_correction_alone(run, tmp_path):
    made, *_ = run("method=afm_physics", "planner=null", f"out={tmp_path / 'policy.pt2'}")
    assert list(made[0].sizes) == ["memory", "observation", "action"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["method=afm_physics"], "out: expected one file"),
        (["method=afm_physics", "out=policy.txt"], "expected a file NAME.pt2 or NAME.onnx"),
        (["method=physics", "out=policy.pt2"], "corrector=none: nothing to export"),
        (["method=online_pe", "corrector=afm", "out=policy.pt2"], "changes at work"),
        (["method=afm_physic", "out=policy.pt2"], "Could not find 'method/afm_physic'"),
    ],
)
def test_a_mistake_ends_in_one_line(run, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    made, status, said = run(*arguments)
    assert (made, status) == ([], 2)
    assert said.startswith("afm-rl-export: ") and words in said and said.count("\n") == 1


def test_without_arguments_it_says_what_it_does(run):
    assert run() == ([], 0, export.ABOUT)
