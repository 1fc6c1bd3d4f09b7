"""What gymnasium's MuJoCo tasks observe in states that are predicted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

UNSEEN = (
    "what is observed in the state in which they act is not known; give observe=, a function from "
    "states (N, S) to observations, or late='leave'"
)


def simulated_observations(
    source: Any, space: gymnasium.Space
) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return a function from states ``(N, S)`` of N simulations to what is observed in them.

    It puts each simulation into its state, looks, and puts it back as it was, to the bit. None
    where that cannot be done: simulations in other processes, or observations that are changed on
    the way.

    Args:
        source: environment, or vector of environments, with MuJoCo's data.
        space: of one observation.
    """
    inner = source.unwrapped
    worlds = getattr(inner, "envs", None) if isinstance(source, VectorEnv) else [inner]
    worlds = [world.unwrapped for world in worlds or []]
    looks = all(hasattr(world, "_get_obs") and hasattr(world, "data") for world in worlds)
    if not worlds or not looks or worlds[0].observation_space != space:
        return None
    import mujoco

    spare: list[Any] = []

    def observe(states: np.ndarray) -> np.ndarray:
        found = []
        for world, state in zip(worlds, states, strict=True):
            model, data = world.model, world.data
            if not spare:
                spare.append(mujoco.MjData(model))
            mujoco.mj_copyData(spare[0], model, data)
            data.qpos[:], data.qvel[:], data.act[:] = np.split(
                state, [model.nq, model.nq + model.nv]
            )
            mujoco.mj_forward(model, data)
            mujoco.mj_rnePostConstraint(model, data)  # forces of contacts
            found.append(np.array(world._get_obs()))
            mujoco.mj_copyData(data, model, spare[0])
        return np.stack(found)

    return observe
