"""What the steps of missions show of the actuators."""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch

from afm_rl.diagnosis import Diagnosis, Log, diagnose
from afm_rl.diagnosis.log import FEWEST
from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import effective_action
from afm_rl.errors import ConfigurationError
from afm_rl.missions.robot import Robot


@torch.no_grad()
def effective_log(
    model: DynamicsModel,
    names: tuple[str, ...],
    states: np.ndarray,
    actions: np.ndarray,
    t: np.ndarray | None = None,
    episode: np.ndarray | None = None,
    unseen: float = 1.0,
) -> Log:
    """Return what states ``(N, S)`` show of actions ``(N, A)``: responses are effective actions.

    The last row of each episode has no next state, and is left out; so are rows in which the
    effective action cannot be seen.

    Args:
        model: of the healthy robot.
        names: of the actions.
        states: before each action.
        actions: as they were executed.
        t: times (s), ``(N,)``.
        episode: numbers of episodes, ``(N,)``.
        unseen: half ranges; effective actions with a larger standard deviation are left out.

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
    known = (seen.std < unseen * scale).all(-1).numpy()
    kept = rows[known]
    return Log(
        names=names,
        command=actions[kept],
        response=seen.action.double().numpy()[known],
        t=kept.astype(float) if t is None else t[kept],
        episode=border[kept],
        computed=True,
        notes=("responses are effective actions, through the model of the healthy robot",),
    )


def explain_mission(
    robot: Robot, steps: pd.DataFrame, newest: int | None = None
) -> tuple[Diagnosis, Log]:
    """Return what the steps of one mission show of the robot's actuators, and the log of these.

    Args:
        robot: its nominal physics says what a healthy one does.
        steps: of one mission, in order.
        newest: how many steps are looked at; None: 3000, or 400 where a simulator takes its time.

    Raises:
        ConfigurationError: if there are too few steps, or none shows what an action did.
    """
    steps = steps[-(newest or (400 if robot.model.stiff else 3000)) :]
    columns = [list(robot.state_names), [f"executed_{name}" for name in robot.action_names]]
    states, actions = (steps[names].to_numpy(dtype=float) for names in columns)
    finite = np.isfinite(states).all(1) & np.isfinite(actions).all(1)
    if not finite.all():
        raise ConfigurationError("steps that are not finite show nothing of the actuators")
    t = steps["t"].to_numpy(dtype=float) * (robot.dt or 1.0)
    log = effective_log(robot.model, tuple(robot.action_names), states, actions, t)
    return diagnose(log), log
