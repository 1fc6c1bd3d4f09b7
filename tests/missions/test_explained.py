"""What steps of missions show of the actuators."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from harness import refused

from afm_rl.dynamics import Dubins
from afm_rl.missions.explained import explain_mission, planned_for
from afm_rl.missions.run import run

ROBOT = SimpleNamespace(
    model=Dubins(dt=0.2), dt=0.2, state_names=["x", "y", "theta"], action_names=["v", "omega"]
)


def drive(steps, v=None, faulty=None, gain=-0.6):
    """Return the steps of a robot whose v has another gain, from half-way on."""
    actions = np.random.default_rng(0).uniform([-1, -1.5], [1, 1.5], (steps, 2))
    actions[:, 0] = actions[:, 0] if v is None else v
    effective = actions.copy()
    effective[faulty or slice(steps // 2, None), 0] *= gain
    states = [torch.zeros(3)]
    for action in effective[:-1]:
        states.append(ROBOT.model(states[-1], torch.tensor(action, dtype=torch.float32)))
    table = pd.DataFrame(torch.stack(states).numpy(), columns=ROBOT.state_names)
    return table.assign(t=range(steps), executed_v=actions[:, 0], executed_omega=actions[:, 1])


def test_a_mission_is_explained():
    found, log = explain_mission(ROBOT, drive(300))
    assert str(found).splitlines() == [
        "v: reversed, 60 % of the command, since step 150 (30 s)",
        "omega: healthy",
    ]
    assert len(log.command) == 299 and log.step == pytest.approx(0.2)


@pytest.mark.slow
@pytest.mark.parametrize("gain", [-1.0, -0.5, -1.7])
@pytest.mark.parametrize("noticed", [2, 4])
@pytest.mark.parametrize("faulty", [slice(40, 210), slice(100, 140)])
def test_a_sign_is_sure_where_commands_are_at_two_levels(gain, noticed, faulty):
    """A planner that saturates: all that tells a reversal from |v| are the steps until it is found.

    Positive commands act in full, and negative ones the other way round: this would explain the
    rest of the steps as well.
    """
    v = np.ones(260)
    v[faulty.start + noticed : faulty.stop + noticed] = -1
    found, _ = explain_mission(ROBOT, drive(260, v, faulty, gain))
    begin, end = (f"{at} ({0.2 * at:.4g} s)" for at in (faulty.start, faulty.stop))
    sentence, *others = str(found).splitlines()
    assert sentence.endswith(f"from step {begin} to {end}, healthy since")
    assert sentence.startswith("v: reversed") and others == ["omega: healthy"]
    low, high = found.actuators[0].changes[0].after.gain_interval  # of two levels, no more is known
    assert low <= gain + 1e-3 and gain - 1e-3 <= high < 0


def test_an_action_that_no_step_shows_does_not_hide_the_others():
    steps = drive(300, np.random.default_rng(1).uniform(-1e-6, 1e-6, 300))
    found, _ = explain_mission(ROBOT, steps.assign(x=steps["x"] + 1e-5 * (steps["t"] % 2)))
    v, omega = found.actuators
    assert v.status == "cannot tell" and omega.status == "healthy"


AT_LEAST = {"budget": 150, "planner.candidates": 200}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "end"), [("afm_physics", "; made up for"), ("adaptive_gain", "")]
)
def test_what_a_method_made_up_for_is_said(method, end, make_agent):
    """Only AFM plans for the state in which its commands act."""
    agent = make_agent(f"method={method}", "tracks=[ethz_2]", "regimes=[{delay: 3}]", **AT_LEAST)
    steps = run(agent).steps
    found, _ = explain_mission(agent.robot, steps, late=planned_for(agent))
    omega = found.actuators[1]
    assert omega.sentence == f"omega: 3 steps late, since step 40{end}"
    assert omega.made_up == bool(end)


@refused(
    (lambda: drive(30)[:5], "at least 20"),
    (lambda: drive(30).assign(x=np.nan), "not finite"),
)
def test_missions_that_show_nothing_are_not(make):
    explain_mission(ROBOT, make())
