"""A log of the actions that explain the states, through a step function."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import torch

from afm_rl.diagnosis import Log
from afm_rl.diagnosis.read import TRANSITIONS, read_columns
from afm_rl.dynamics import DynamicsModel, KnownDynamics
from afm_rl.dynamics.inverse import effective_action
from afm_rl.errors import ConfigurationError
from afm_rl.manifold import Manifold
from afm_rl.targets import find_code

UNSEEN = 1.0  # half ranges: effective actions with a larger standard deviation are left out


def read_effective(path: Path, name: str) -> Log:
    """Return a log whose commands are the actions, and whose responses are effective actions.

    Args:
        path: a file with columns ``action.NAME`` and ``state.NAME``, or a folder of LeRobot's.
        name: of the step function, ``module.function``; the present folder is searched, too.

    Raises:
        ConfigurationError: if the file or the function cannot be used.
    """
    found = read_columns(path, TRANSITIONS)
    sys.path.insert(0, os.getcwd())
    try:
        step = find_code("--model", name)
    finally:
        sys.path.pop(0)
    states = found.second.shape[1]
    model = KnownDynamics(step, Manifold(states), found.first.shape[1])
    names = tuple(found.names[0])
    return effective_log(model, names, found.second, found.first, found.t, found.episode)


@torch.no_grad()
def effective_log(
    model: DynamicsModel,
    names: tuple[str, ...],
    states: np.ndarray,
    actions: np.ndarray,
    t: np.ndarray | None = None,
    episode: np.ndarray | None = None,
) -> Log:
    """Return what states ``(N, S)`` show of actions ``(N, A)``, through a model.

    The last row of each episode has no next state, and is left out.
    """
    border = np.zeros(len(states), dtype=int) if episode is None else episode
    rows = np.flatnonzero(np.diff(border) == 0)
    state, action, after = (
        torch.as_tensor(x, dtype=torch.float64)
        for x in (states[rows], actions[rows], states[rows + 1])
    )
    scale = action.abs().amax(0).clamp_min(1e-9)
    seen = effective_action(model.double(), state, action, after, scale)
    known = (seen.std < UNSEEN * scale).all(-1).numpy()
    if not known.any():
        raise ConfigurationError(
            "--model: no state shows what an action does: expected a step function whose next "
            "state depends on every action"
        )
    kept = rows[known]
    return Log(
        names=names,
        command=actions[kept],
        response=seen.action.numpy()[known],
        t=kept.astype(float) if t is None else t[kept],
        episode=border[kept],
        notes=("responses are effective actions, computed by --model",),
    )
