"""What the steps of missions show of the actuators."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd

from afm_rl.correction import ClassicalCorrector
from afm_rl.diagnosis import Actuator, Diagnosis, Log, diagnose
from afm_rl.diagnosis.log import FEWEST
from afm_rl.diagnosis.pairs import effective_log
from afm_rl.errors import ConfigurationError
from afm_rl.missions.build import Agent
from afm_rl.missions.robot import Robot


def explain_mission(
    robot: Robot, steps: pd.DataFrame, late: int | None = None
) -> tuple[Diagnosis, Log]:
    """Return what the steps of one mission show of the robot's actuators, and the log of these.

    Args:
        robot: its nominal physics says what a healthy one does.
        steps: of one mission, in order: the last 3000, or 400 where a simulator takes its time.
        late: delays up to this one (steps) were planned for by the correction; None if there was
            none. What it corrected is said to be made up for.

    Raises:
        ConfigurationError: if there are too few steps, or none shows what an action did.
    """
    steps = steps[-400 if robot.model.stiff else -3000 :]
    columns = [list(robot.state_names), [f"executed_{name}" for name in robot.action_names]]
    states, actions = (steps[names].to_numpy(dtype=float) for names in columns)
    finite = np.isfinite(states).all(1) & np.isfinite(actions).all(1)
    if not finite.all():
        raise ConfigurationError("steps that are not finite say nothing about the actuators")
    t = steps["t"].to_numpy(dtype=float) * (robot.dt or 1.0)
    if len(steps) <= FEWEST:
        raise ConfigurationError(f"{len(steps)} steps: expected at least {FEWEST} of an episode")
    known = states[:-1], actions[:-1], states[1:], t[:-1]
    log = effective_log(robot.model, robot.action_names, *known)
    diagnosis = diagnose(log)
    if late is None:
        return diagnosis, log
    rows = np.searchsorted(t, log.seconds)
    planned = steps[[f"planned_{name}" for name in robot.action_names]].to_numpy(dtype=float)

    def made_up(j: int, actuator: Actuator) -> bool:
        """Did it do what was planned, at most ``late`` steps before, in the end of each fault?

        That is, to within a twentieth of its half range in nine tenths of the steps.
        """
        since, pieces = zip(*actuator.pieces, strict=True)
        for begin, end, piece in zip(since, (*since[1:], np.inf), pieces, strict=True):
            ago = round(piece.delay_s / log.step)
            use = (log.since >= begin) & (log.since < end) & (rows >= ago)
            use &= np.cumsum(use) > use.sum() / 2  # the correction needs some steps
            far = np.abs(log.response[use, j] - planned[rows[use] - ago, j])
            near = use.any() and np.quantile(far, 0.9) < 0.025 * np.ptp(planned[:, j])
            if piece.status != "healthy" and not (0 <= ago <= late and near):
                return False
        return actuator.status == "changed"

    actuators = tuple(
        replace(actuator, made_up=True, sentence=f"{actuator.sentence}; made up for")
        if made_up(j, actuator)
        else actuator
        for j, actuator in enumerate(diagnosis.actuators)
    )
    return replace(diagnosis, actuators=actuators), log


def planned_for(agent: Agent) -> int | None:
    """Return the longest delay that an agent plans for (steps); None if nothing is corrected."""
    if agent.transform is None or not agent.transform.enabled:
        return None
    corrector = agent.transform.corrector
    return corrector.delay + getattr(corrector, "max_delay", 0)


def rank(agent: Agent) -> int:
    """Return whose missions show more of the actuators: 0, AFM; 1, what textbooks have; 2, none."""
    if agent.transform is None or planned_for(agent) is None:
        return 2
    return int(isinstance(agent.transform.corrector, ClassicalCorrector))
