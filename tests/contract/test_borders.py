"""Which rooms of the house the transform and the wrapper enter: none that they do not need."""

import runpy
import subprocess
import sys

import pytest
from pages import ROOT

BEYOND = {
    "diagnosis",
    "jobs",
    "learning",
    "missions",
    "planning",
    "report",
    "replay",
    "cli",
    "play",
}


@pytest.mark.parametrize("name", ["TRANSFORM", "WRAPPER"])
def test_a_correction_loads_what_it_needs_and_nothing_else(name):
    house = runpy.run_path(str(ROOT / "benchmarks" / "house.py"))
    loaded = house["run"](house[name])["loaded"]
    assert house["rooms"](loaded).isdisjoint(BEYOND)
    assert "afm_rl/correction/tick.py" in loaded
    assert "afm_rl/transforms/record.py" not in loaded  # nothing is recorded


def test_a_diagnosis_needs_no_torch():
    code = "from afm_rl.diagnosis import Log, diagnose; import numpy as np, sys\n"
    code += (
        "u = np.random.default_rng(0).uniform(-1, 1, (100, 1)); diagnose(Log(('pan',), u, -u))\n"
    )
    code += "assert 'torch' not in sys.modules"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
