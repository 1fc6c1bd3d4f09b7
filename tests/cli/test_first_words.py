"""What a command says of actuators is true."""

import math
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from afm_rl.report import read_runs

ROOT = Path(__file__).parents[2]
DEMO = re.search(r"afm-rl (hydra.run.dir=.*)", (ROOT / "Makefile").read_text())[1]
README = re.findall(r"^\.venv/bin/afm-rl ([^#\n]+)", (ROOT / "README.md").read_text(), re.M)
ONE, SEVERAL, QUADROTOR = README
LONE = "compare=[afm_physics]"  # the last lines do not speak of the others, which take their time
QUIET = ["progress=false", "figures=false", "tensorboard=false", "video=false", "diagnosis=true"]


@pytest.fixture
def said(afm_rl, tmp_path):
    """Run a command with other settings; return what it says, its mission and faulty steps."""

    def run(command, *others):
        texts = [*shlex.split(command), *others, *QUIET, f"hydra.run.dir={tmp_path}"]
        done = afm_rl(*{text.partition("=")[0]: text for text in texts}.values())
        assert (done.status, done.err) == (0, "")
        which, *told = done.out.partition("Actuators, by the steps of ")[2].splitlines()
        assert which.startswith("afm_physics, ")
        runs = read_runs([tmp_path])
        mission = runs.missions[runs.missions["method"] == "afm_physics"].iloc[0]
        steps = runs.steps().query("mission == @mission.mission")
        faulty = np.flatnonzero(steps["regime_active"])
        return dict(line.split(": ", 1) for line in told[:-1]), mission, faulty

    return run


def story(gain, faulty):
    """Return the expected sentence of an actuator whose fault ends and is corrected."""
    fault = ["reversed"] * bool(gain < 0)
    fault += [f"{100 * abs(gain):.0f} % of the command"] * bool(abs(gain) != 1)
    what = ", ".join(fault) + "," * (len(fault) > 1)
    when = f"from step {faulty[0]} to {faulty[-1] + 1}, healthy since; made up for"
    return f"{what} {when}" if fault else "healthy"


GAIN = [LONE, "regimes=[{omega_gain: -0.8}]"]
TIME = ["regimes=[{v_gain: -1, omega_gain: 2}]", "robot.schedule.at=[0.3, 0.6]", "seeds=1"]


@pytest.mark.parametrize(
    ("command", "others"),
    [(DEMO, [LONE]), (ONE, ["seeds=1"]), (DEMO, GAIN), (ONE, TIME)],
    ids=["make demo", "one method", "another gain", "another time"],
)
def test_a_fault_is_told_with_its_times(said, command, others):
    """The planner saturates: commands are at two levels, one in the fault and one outside of it."""
    told, mission, faulty = said(command, *others)
    assert told == {name: story(mission[f"{name}_gain"], faulty) for name in ("v", "omega")}


def test_of_several_methods_that_correct_afm_is_told(said):
    """Slip is not a gain: the reported gain lies between its slopes at rest and at the peak."""
    told, mission, faulty = said(SEVERAL, "compare=[adaptive_gain, afm_physics]")
    assert len(told) == 2
    rise = mission["slip_peak"] / mission["slip_at"]
    for sentence in told.values():
        assert f"from step {faulty[0]} to " in sentence
        end = re.search(r" to (\d+), healthy since", sentence)
        assert end is not None and abs(int(end[1]) - faulty[-1] - 1) <= 1
        if "%" not in sentence or "unexplained" in sentence:  # slip may be reported without a gain
            continue
        low, high = re.search(r"(\d+)(?: to (\d+))? %", sentence).groups()
        assert rise < float(high or low) / 100 and float(low) / 100 < math.e * rise


def test_what_is_not_commanded_does_not_hide_the_rest(said):
    """Half the mass from 2 s on, and a third too much from 5 s on, are thrust; yaw is at rest."""
    told, _, faulty = said(QUADROTOR, LONE)
    assert faulty[0] == 40
    assert told == {
        "thrust": "200 % of the command from step 40 to 100; 75 % of the command, since step 100; "
        "made up for",
        **dict.fromkeys(["moment_x", "moment_y"], "healthy"),
        "moment_z": "cannot tell: its command does not change; move it",
    }
