"""Which rooms of the house the transform and the wrapper enter: none that they do not need."""

import subprocess
import sys

import house
import pytest
from pages import ROOT

WRAPPER = """
import gymnasium
from afm_rl import ActionFlowWrapper, FaultWrapper
env = ActionFlowWrapper(FaultWrapper(gymnasium.make("Swimmer-v5"), "all reversed"), model="mujoco")
env.action_space.seed(0)
env.reset(seed=0)
corrected = 0
for _ in range(50):
    *_, info = env.step(env.action_space.sample())
    corrected += info["afm"]["corrects"]
"""

BEYOND = {"diagnosis", "jobs", "learning", "missions", "planning", "report", "cli", "play"}


@pytest.mark.parametrize("program", [house.TRANSFORM, WRAPPER], ids=["transform", "wrapper"])
def test_a_correction_loads_what_it_needs_and_nothing_else(program):
    files = house.git(ROOT, "ls-files", "afm_rl", "envs")
    loaded = house.trace(program, files)["loaded"]
    assert {*map(house.rooms.room, loaded)}.isdisjoint(BEYOND)
    assert "afm_rl/correction/core.py" in loaded
    assert "afm_rl/transforms/record.py" not in loaded  # nothing is recorded


def test_a_diagnosis_needs_no_torch():
    code = "from afm_rl.diagnosis import Log, diagnose; import numpy as np, sys\n"
    code += (
        "u = np.random.default_rng(0).uniform(-1, 1, (100, 1)); diagnose(Log(('pan',), u, -u))\n"
    )
    code += "assert 'torch' not in sys.modules"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
