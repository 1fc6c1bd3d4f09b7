"""What gymnasium's MuJoCo tasks observe in states that are predicted."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorObservationWrapper

UNSEEN = (
    "what is observed in the state in which they act is not known; give observe=, a function from "
    "states (N, S) to observations, or late='leave'"
)
CHANGED = gymnasium.ObservationWrapper, VectorObservationWrapper


def simulated_observations(
    source: Any, space: gymnasium.Space
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return a function from states ``(N, S)`` to what an environment observes in them.

    It looks through the environment's own eyes, at a simulation beside its own. None where that
    cannot be done: no task of gymnasium's with MuJoCo, or observations that are changed on the way.

    Args:
        source: environment, or vector of environments alike, which are not touched.
        space: of one observation.
    """
    layers = _layers(source)
    if isinstance(source, VectorEnv):
        makers = getattr(source.unwrapped, "env_fns", None)  # also where they run elsewhere
        layers += _layers(makers[0]()) if makers else []
    inner = layers[-1]
    if not all(hasattr(inner, name) for name in ("_get_obs", "data", "model")):
        return None
    if inner.observation_space != space or any(isinstance(env, CHANGED) for env in layers):
        return None
    import mujoco

    model, twin = inner.model, copy(inner)
    twin.data = data = mujoco.MjData(model)
    ends = [model.nq, model.nq + model.nv]

    def observe(states: np.ndarray) -> np.ndarray:
        found = []
        for state in states:
            data.qpos[:], data.qvel[:], data.act[:] = np.split(state, ends)
            mujoco.mj_forward(model, data)
            mujoco.mj_rnePostConstraint(model, data)  # forces of contacts
            found.append(np.array(twin._get_obs()))
        return np.stack(found)

    return observe


def _layers(env: Any) -> list[Any]:
    """Return the wrappers of an environment, the outermost first, and itself."""
    found = [env]
    while hasattr(found[-1], "env"):
        found.append(found[-1].env)
    return found
