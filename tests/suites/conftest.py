"""Suites are used as a command uses them: packages that it trusts, with their settings."""

import importlib
import sys
from pathlib import Path

import pytest
from harness import agent_trusting, shrink

SUITES = Path(__file__).parents[2] / "benchmarks" / "suites"
sys.path.append(str(SUITES))


@pytest.fixture
def agent_of():
    """Build what a command asks for."""

    def make(suite, *overrides):
        return agent_trusting(SUITES / suite, *overrides, change=shrink)

    return make


@pytest.fixture
def suite(request, monkeypatch):
    """Import modules by name of the suite that a file tests, and then forget them."""
    folder = SUITES / request.path.stem.removeprefix("test_")
    beside = [SUITES / name for name in getattr(request.module, "BESIDE", ())]
    names = [path.stem for each in (*beside, folder) for path in each.glob("*.py")]
    for each in (*beside, folder):
        monkeypatch.syspath_prepend(str(each))
    for name in names:
        sys.modules.pop(name, None)
    yield importlib.import_module
    for name in names:
        sys.modules.pop(name, None)


@pytest.fixture
def command(suite, called):
    """Run a program of the suite; return its output."""

    def run(name, *arguments):
        done = called(suite(name).main, name, *arguments)
        assert done.status == 0, done.err
        return done.out

    return run
