"""C is compiled once, beside, in a folder that nobody else may write."""

import subprocess
import time

import numpy as np
import pytest
import torch

from afm_rl.compiling import library
from afm_rl.compiling.c_source import as_c
from afm_rl.compiling.library import Library, write_library
from afm_rl.compiling.onnx_graph import as_onnx, trace


class Branches(torch.nn.Module):
    """Halves numbers if their sum is positive; else returns them."""

    def forward(self, numbers):
        def halved():
            return (0.5 * numbers).exp().log()

        return (torch.cond(numbers.sum() > 0, halved, lambda: numbers.clone()),)


@pytest.fixture(scope="module")
def graph():
    """A graph with a branch, as bytes."""
    traced = trace(Branches(), [torch.ones(3)])
    return as_onnx(traced, ["numbers"], ["found"], {})


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache."""
    monkeypatch.setenv("AFM_RL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "c"


def run(code, numbers):
    """Return what a function makes of rows of numbers."""
    rows = np.asarray(numbers, np.float32)
    found, workspace = np.empty_like(rows), np.empty(code.workspace, np.uint8)
    places = [array.ctypes.data_as(library.ctypes.c_void_p) for array in (rows, found, workspace)]
    code.function(library.ctypes.c_size_t(len(rows)), *places)
    return found


def test_it_is_compiled_beside_and_says_what_the_graph_says(graph, cache):
    one = Library(graph, "halve")
    begun = time.monotonic()
    assert one.load() is None and time.monotonic() - begun < 5  # nobody waits
    code = one.load(wait=True)
    assert not one.reason
    np.testing.assert_allclose(run(code, [[1, 2, 3], [-1, -2, 2]]), [[0.5, 1, 1.5], [-1, -2, 2]])
    assert [path.name for path in cache.iterdir()] == [one.path.name]
    again = Library(graph, "halve")
    assert again.load() is not None and again.process is None  # it is there


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_what_others_may_write_is_not_run(graph, cache, mode):
    cache.mkdir(parents=True)
    cache.chmod(mode)
    one = Library(graph, "halve")
    assert one.load(wait=True) is None and "only you may write" in one.reason


def test_without_a_compiler_the_reason_is_said(graph, cache, monkeypatch):
    monkeypatch.setattr(library.shutil, "which", lambda name: None)
    one = Library(graph, "halve")
    assert one.load(wait=True) is None and "no C compiler was found" in one.reason


def test_what_cannot_be_compiled_is_said_once(cache):
    one = Library(b"no graph", "halve")
    with pytest.warns(UserWarning, match="core: goes on without C"):
        assert one.load(wait=True) is None
    assert one.load(wait=True) is None and one.reason


def test_a_compiler_that_fails_leaves_nothing(graph, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "false")
    with pytest.raises(subprocess.CalledProcessError):
        write_library(graph, "halve", tmp_path / "halve.so")
    assert not list(tmp_path.iterdir())


def test_only_the_side_that_is_taken_is_computed(graph):
    code = as_c(graph, "halve")
    inside = code[code.index("static void halve_one") :]
    taken, other = inside.index("if ("), inside.index("if (!")
    assert taken < inside.index("_then_", taken) < other < inside.index("_else_", other)


def test_it_needs_little_stack_no_heap_and_no_state(graph, tmp_path):
    source = tmp_path / "halve.c"
    source.write_text(as_c(graph, "halve"))
    assert "malloc" not in source.read_text()
    run_cc = ["gcc", *library.FLAGS, "-fstack-usage", "-o", str(tmp_path / "a.so"), str(source)]
    subprocess.run([*run_cc, "-lm"], check=True, cwd=tmp_path)
    (usage,) = tmp_path.glob("*.su")
    assert max(int(line.split("\t")[1]) for line in usage.read_text().splitlines()) < 64_000
