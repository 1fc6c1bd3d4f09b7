"""Suites are used as a command uses them: packages that it trusts, with their settings."""

import importlib
import sys
from pathlib import Path

import pytest
from harness import agent_trusting, shrink

SUITES = Path(__file__).parents[2] / "benchmarks" / "suites"
BESIDE = {"legged": ["zoo"]}  # suites whose modules another one imports
sys.path.append(str(SUITES))


@pytest.fixture
def agent_of():
    """Build what a command asks for."""

    def make(suite, *overrides):
        return agent_trusting(SUITES / suite, *overrides, change=shrink)

    return make


@pytest.fixture
def suite(request, monkeypatch):
    """Import modules by name of the suite that a file or a test names, then forget them."""
    words = [request.path.stem, request.function.__name__]
    names = sorted((folder.name for folder in SUITES.iterdir()), key=len, reverse=True)
    name = next(n for n in names for word in words if word.startswith(f"test_{n}"))
    folders = [SUITES / each for each in (*BESIDE.get(name, []), name)]
    modules = [path.stem for folder in folders for path in folder.glob("*.py")]
    for folder in folders:
        monkeypatch.syspath_prepend(str(folder))
    for module in modules:
        sys.modules.pop(module, None)
    yield importlib.import_module
    for module in modules:
        sys.modules.pop(module, None)


@pytest.fixture
def command(suite, called):
    """Run a program of the suite; return its output."""

    def run(name, *arguments):
        done = called(suite(name).main, name, *arguments)
        assert done.status == 0, done.err
        return done.out

    return run
