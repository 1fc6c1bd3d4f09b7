"""Executed actions beside those that explain what they did: logs whose responses are computed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from afm_rl.diagnosis.findings import Actuator, Diagnosis
from afm_rl.diagnosis.log import FEWEST, Log
from afm_rl.diagnosis.verdict import diagnose
from afm_rl.errors import ConfigurationError

if TYPE_CHECKING:
    from afm_rl.dynamics import DynamicsModel

LEAST = 8  # pairs of which something is said


def effective_log(
    model: DynamicsModel,
    names: Sequence[str],
    states: np.ndarray,
    actions: np.ndarray,
    next_states: np.ndarray,
    t: np.ndarray,
    episode: np.ndarray | None = None,
    fewest: int = FEWEST,
    **about: Any,
) -> Log:
    """Return what N transitions show of actions ``(N, A)``: responses are effective actions.

    A row counts if their standard deviations are below the largest action. An action that hardly
    any row shows counts as none: too little was commanded.

    Raises:
        ConfigurationError: if too few transitions show what an action did.
    """
    import torch

    from afm_rl.dynamics.inverse import effective_action

    kind = torch.float64 if model.stiff else torch.get_default_dtype()
    given = (np.array(x) for x in (states, actions, next_states))  # also those read only
    state, action, after = (torch.from_numpy(x).to(kind) for x in given)
    with torch.no_grad():
        scale = action.abs().amax(0).clamp_min(1e-9)
        seen = effective_action(model, state, action, after, scale)
    visible = (seen.std < 1).numpy()
    shown = visible.sum(0) >= fewest
    known = visible[:, shown].all(-1) & shown.any()
    if known.sum() < fewest:
        raise ConfigurationError(
            f"{known.sum()} of {len(known)} steps show the effect of an action: expected at least "
            f"{fewest}; is the model right?"
        )
    rows = np.flatnonzero(known)
    return Log(
        names=tuple(names),
        command=np.asarray(actions)[rows] * shown,
        response=seen.action.double().numpy()[rows] * shown,
        t=t[rows],
        episode=None if episode is None else episode[rows],
        row=rows,
        read_from=len(known),
        computed=True,
        notes=("responses are effective actions, through the model of the healthy robot",),
        **about,
    )


def judge_steps(
    model: DynamicsModel,
    names: Sequence[str],
    steps: Sequence[tuple[int, Any, Any, Any]],
    delay: int = 0,
    action_space: Any = None,
) -> Diagnosis:
    """Say what steps show of each actuator.

    Args:
        model: of the healthy robot.
        names: of its actuators.
        steps: number of the episode, state, executed action, and next state of each, in order.
        delay: of the healthy robot (steps).
        action_space: a gymnasium box; None: unknown.
    """
    episode, states, actions, after = (np.stack(x) for x in zip(*steps, strict=True))
    late = np.arange(len(steps)) - delay  # whose actions act
    known = (
        np.isfinite(np.hstack([states, actions, after])).all(-1)
        & (late >= 0)
        & (episode == episode[late])
    )
    t = getattr(model, "dt", 1.0) * np.arange(len(steps))
    space = action_space
    about: Any = {"fewest": LEAST, "command_bounds": space and (space.low, space.high)}
    rows = states[known], actions[late[known]], after[known], t[known], episode[known]
    try:
        return diagnose(effective_log(model, names, *rows, **about))
    except ConfigurationError:
        why = f"cannot tell: {known.sum()} steps show too little; let it move"
        none = (Actuator(name=name, sentence=f"{name}: {why}") for name in names)
        return Diagnosis(actuators=tuple(none))
