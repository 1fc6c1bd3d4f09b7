"""What the steps of missions show of the actuators."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from afm_rl.correction import ClassicalCorrector
from afm_rl.diagnosis import Actuator, Diagnosis, Log, Settings, diagnose
from afm_rl.diagnosis.log import FEWEST
from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import effective_action
from afm_rl.errors import ConfigurationError
from afm_rl.missions.build import Agent
from afm_rl.missions.robot import Robot


@torch.no_grad()
def effective_log(
    model: DynamicsModel,
    names: tuple[str, ...],
    states: np.ndarray,
    actions: np.ndarray,
    t: np.ndarray | None = None,
    episode: np.ndarray | None = None,
) -> Log:
    """Return what states ``(N, S)`` show of actions ``(N, A)``: responses are effective actions.

    The last row of each episode has no next state, and is left out; so are rows in which the
    effective action cannot be seen: its standard deviation is above the largest action. An action
    that hardly any row shows counts as none: too little was commanded.

    Raises:
        ConfigurationError: if too few states show what an action did.
    """
    border = np.zeros(len(states), dtype=int) if episode is None else episode
    rows = np.flatnonzero(np.diff(border) == 0)
    if len(rows) < FEWEST:
        raise ConfigurationError(f"{len(states)} steps: expected at least {FEWEST} of an episode")
    state, action, after = (
        torch.as_tensor(x, dtype=torch.get_default_dtype())
        for x in (states[rows], actions[rows], states[rows + 1])
    )
    scale = action.abs().amax(0).clamp_min(1e-9)
    seen = effective_action(model, state, action, after, scale)
    visible = (seen.std < scale).numpy()
    shown = visible.sum(0) >= FEWEST
    known = visible[:, shown].all(-1) & shown.any()
    if known.sum() < FEWEST:
        raise ConfigurationError(
            f"{known.sum()} of {len(rows)} steps show what an action did: expected at least "
            f"{FEWEST}; is the model right?"
        )
    used = rows[known]
    return Log(
        names=names,
        command=actions[used] * shown,
        response=seen.action.double().numpy()[known] * shown,
        t=used.astype(float) if t is None else t[used],
        episode=border[used],
        computed=True,
        notes=("responses are effective actions, through the model of the healthy robot",),
    )


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
        raise ConfigurationError("steps that are not finite show nothing of the actuators")
    t = steps["t"].to_numpy(dtype=float) * (robot.dt or 1.0)
    log = effective_log(robot.model, tuple(robot.action_names), states, actions, t)
    diagnosis = diagnose(log, Settings(shared=None))  # a delay is no part of the robot's model
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
    return corrector.delay + getattr(corrector, "longest_delay", 0)


def rank(agent: Agent) -> int:
    """Return whose missions show more of the actuators: 0, AFM; 1, what textbooks have; 2, none."""
    if agent.transform is None or planned_for(agent) is None:
        return 2
    return int(isinstance(agent.transform.corrector, ClassicalCorrector))
