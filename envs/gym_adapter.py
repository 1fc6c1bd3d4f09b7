"""What the gymnasium adapters of the ground robot share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from tensordict import TensorDictBase

from afm_rl.envs.track import Track
from afm_rl.envs.ugv import UGVTrack
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import Regime, Schedule


def build_native(
    track: str | Path | Track,
    regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None,
    gains: Mapping[str, float | None],
    schedule: Schedule | Sequence[float] | None,
    ramp: int,
    family: Regime | None,
    batch_size: tuple[int, ...],
    settings: Mapping[str, Any],
) -> UGVTrack:
    """Return the native environment, with the same regime for every mission.

    Args:
        track: name, CSV path or track.
        regime: parameters of the changed phase, or one mapping per phase.
        gains: more parameters of the changed phase; None where not given.
        schedule: a schedule, or breakpoints of the progress.
        ramp: steps that each change takes.
        family: regime family; gains on v and omega if None.
        batch_size: number of missions.
        settings: further arguments of :class:`~afm_rl.envs.UGVTrack`.

    Raises:
        ConfigurationError: for a setting that cannot be used.
    """
    if schedule is not None and not isinstance(schedule, Schedule):
        schedule = Schedule(schedule)
    given = {name: value for name, value in gains.items() if value is not None}
    if given:
        if regime is not None and not isinstance(regime, Mapping):
            raise ConfigurationError(f"regime={regime!r}: per phase, so {given} belongs inside it")
        regime = {**(regime or {}), **given}
    return UGVTrack(
        tracks=(track,),
        regime=family,
        schedule=schedule,
        batch_size=batch_size,
        missions={"regime": regime, "ramp": ramp},
        **settings,
    )


def spaces(env: UGVTrack) -> tuple[Box, Box]:
    """Return the observation space (x, y, theta, goal x, goal y) and the action space."""
    bounds = np.array([np.inf, np.inf, np.pi, np.inf, np.inf], dtype=np.float32)
    low, high = (
        bound.cpu().numpy().astype(np.float32)
        for bound in (env.simulation.low, env.simulation.high)
    )
    return Box(-bounds, bounds, dtype=np.float32), Box(low, high, dtype=np.float32)


def require_reset(data: TensorDictBase | None) -> TensorDictBase:
    """Return ``data``, which is None before the first reset.

    Raises:
        gymnasium.error.ResetNeeded: if it is None.
    """
    if data is None:
        raise ResetNeeded("call reset() before step() or render()")
    return data


def observe(env: UGVTrack, data: TensorDictBase) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the observation ``(*B, 5)`` and the info of each mission.

    The info holds the number of targets ``reached``, the ``progress`` in [0, 1], and, as a
    truth hidden from the observation, ``regime_active``.
    """
    seen = torch.cat([data["observation"], data["goal"]], -1)
    info = {
        "reached": data["reached"],
        "progress": env.course.progress(data["mission", "track"], data["reached"]),
        "regime_active": data["regime_active"],
    }
    return seen.cpu().numpy().astype(np.float32), {k: v.cpu().numpy() for k, v in info.items()}
