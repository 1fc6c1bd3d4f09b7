"""A nominal model is fitted to the steps of a healthy robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.diagnosis.suspect import history, suspect
from afm_rl.dynamics import DynamicsModel, KnownDynamics, LinearResidual
from afm_rl.errors import ConfigurationError, check_count, check_flag, warn
from afm_rl.learning.residual_fit import relevant_coordinates, residual_parts
from afm_rl.spaces.manifold import Manifold

LEAST_STEPS = 50
PROBED = 20  # steps in which is looked on which coordinates the motion depends


@torch.no_grad()
def fit_residual(
    model: DynamicsModel | Callable[[Tensor, Tensor], Tensor],
    recording: str | Path | TensorDictBase | Sequence[Any],
    delay: int = 0,
    guard: bool = True,
) -> LinearResidual:
    """Fit what a nominal model misses of a healthy robot to some of its steps.

    About 100 steps of the usual policy are enough. Give the result in the place of the model, save
    it with :meth:`~afm_rl.dynamics.LinearResidual.save`, and load it at each start.

    Args:
        model: the nominal model: a :class:`~afm_rl.dynamics.DynamicsModel`, or a step function
            ``step(state, action) -> next_state`` in torch, batched. It is not changed.
        recording: the CSV file that ``record=`` wrote; a tensordict with ``"observation"``,
            ``"action"`` and ``("next", "observation")``; or states ``(N, S)``, executed actions
            ``(N, A)`` and next states ``(N, S)``. In the order of time.
        delay: known steps from an action to its effect.
        guard: refuse steps that look like a fault of the actuators: it would be learnt as normal.

    Raises:
        ConfigurationError: for fewer than 50 valid steps, or sizes of another robot; if the steps
            look like a fault; or if there is nothing to improve.

    >>> from afm_rl.dynamics import Dubins
    >>> generator = torch.Generator().manual_seed(0)
    >>> state, action = (torch.randn(100, n, generator=generator) for n in (3, 2))
    >>> after = Dubins()(state, 1.1 * action)  # its wheels are larger
    >>> model = fit_residual(Dubins(), (state, action, after))
    >>> bool((model.explained > 0.9).all())
    True
    """
    check_count("fit_residual: delay", delay, low=0)
    check_flag("fit_residual: guard", guard)
    known = model if isinstance(model, DynamicsModel) else None
    state, action, after = _transitions(recording, known)
    if not isinstance(model, DynamicsModel):
        model = KnownDynamics(model, Manifold(state.shape[-1]), action.shape[-1])
    _check_sizes(model, state, action, after)
    fitted = LinearResidual(model)
    action = history(state, action, after, delay)[:, delay]
    valid = torch.cat([state, action, after], -1).isfinite().all(-1)
    state, action, after = (rows[valid] for rows in (state, action, after))
    if len(state) < LEAST_STEPS:
        raise ConfigurationError(
            f"fit_residual: {len(state)} of {len(valid)} steps are finite: expected at least "
            f"{LEAST_STEPS}; record more of the healthy robot"
        )
    names = getattr(model, "names", ((), ()))[1]
    if guard and (fault := suspect(model, state, action, after, names)):
        raise ConfigurationError(
            f"fit_residual: these steps look like a fault: {fault}; record the healthy robot, or "
            "give guard=False if it is healthy"
        )
    probed = torch.linspace(0, len(state) - 1, PROBED).long()
    relevant = relevant_coordinates(model, state[probed], action[probed])
    predicted = model(state, action)
    parts = residual_parts(model.manifold, state, predicted, after, relevant)
    stated = model.noise_scale(state, action).mean(0)
    if not bool((parts["explained"] > 0).any()):
        if not bool((parts["noise"] > stated).any()):
            raise ConfigurationError(
                f"fit_residual: nothing improves the model in {len(state)} steps, and it misses no "
                "more than the noise that it states; use it as it is"
            )
        warn(
            f"fit_residual: nothing improves the predictions of the model in {len(state)} steps: "
            "only the noise is measured; record more steps, or more motion"
        )
    return fitted.fitted_(**parts)


def _check_sizes(model: DynamicsModel, *rows: Tensor) -> None:
    shapes = [tuple(part.shape) for part in rows]
    sizes = (model.state_size, model.action_size, model.state_size)
    if shapes != [(len(rows[0]), size) for size in sizes]:
        raise ConfigurationError(
            f"fit_residual: states, actions and next states {shapes}: expected rows of {sizes} "
            "numbers, as the model has them; give the model of this robot"
        )


def _transitions(recording: Any, model: DynamicsModel | None) -> list[Tensor]:
    """Return states, executed actions and next states of a recording."""
    kind = torch.get_default_dtype() if model is None or not model.stiff else torch.float64
    if isinstance(recording, str | Path):
        rows = _recorded(Path(recording), model)
    elif isinstance(recording, TensorDictBase):
        names = ("observation", "action", ("next", "observation"))
        rows = [recording.get(name, None) for name in names]
        if any(part is None for part in rows):
            raise ConfigurationError(
                f"fit_residual: recording with {[*recording.keys(True, True)]}: expected {[*names]}"
            )
        rows = [part.reshape(-1, part.shape[-1]) for part in rows]
    else:
        rows = list(recording)
        if len(rows) != 3:
            raise ConfigurationError(
                f"fit_residual: recording of {len(rows)} parts: expected states, actions and next "
                "states, a tensordict, or the name of a CSV file"
            )
    return [torch.as_tensor(part).to(kind) for part in rows]


def _recorded(path: Path, model: DynamicsModel | None) -> list[np.ndarray]:
    """Return the steps in a file of ``record=``, in the order of a model's names."""
    from afm_rl.diagnosis.readers import read_columns

    columns = read_columns(path, ("command", "state"))
    states, actions = getattr(model, "names", None) or columns.names[::-1]
    missing = [*set(actions) - {*columns.names[0]}, *set(states) - {*columns.names[1]}]
    if missing:
        raise ConfigurationError(
            f"fit_residual: {path}: has no column for {', '.join(sorted(missing))}, which the "
            "model has; give the model of this robot"
        )
    action = columns.first[:, [columns.names[0].index(name) for name in actions]]
    state = columns.second[:, [columns.names[1].index(name) for name in states]]
    same = np.diff(columns.episode) == 0
    if same.any():  # rows without a valid reading are not recorded
        pauses = np.diff(columns.t)
        same &= pauses < 1.5 * np.median(pauses[same])
    rows = np.flatnonzero(same)
    return [state[rows], action[rows], state[rows + 1]]
