"""Suites are used as a command uses them: packages that it trusts, with their settings."""

import importlib
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from afm_rl.cli.overrides import checked
from afm_rl.missions import build

SUITES = Path(__file__).parents[2] / "benchmarks" / "suites"
sys.path.append(str(SUITES))
SMALL = {"planner.population": 8, "planner.elites": 2, "robot.contexts": 2}


@pytest.fixture
def agent_of():
    """Build what a command asks for."""

    def make(suite, *overrides):
        asked = [f"trust=[{SUITES / suite}]", *overrides]
        with checked(asked) as names, initialize_config_module("afm_rl.conf", version_base="1.3"):
            cfg = compose("config", asked)
            for key, value in SMALL.items():
                if OmegaConf.select(cfg, key) is not None:
                    OmegaConf.update(cfg, key, value)
            return build(cfg, names)

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
