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
def modules_of(monkeypatch):
    """Import a suite's modules by name; they are forgotten afterwards."""
    names = []

    def begin(suite):
        names.extend(path.stem for path in suite.glob("*.py"))
        monkeypatch.syspath_prepend(str(suite))
        for name in names:
            sys.modules.pop(name, None)
        return importlib.import_module

    yield begin
    for name in names:
        sys.modules.pop(name, None)
