"""The quadrotor as a gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.courses.reference import Reference
from afm_rl.envs.missions.gym import MissionGym
from afm_rl.envs.quadrotor.env import CrazyflieTrack
from afm_rl.errors import ConfigurationError


class CrazyflieTrackGym(MissionGym):
    """One mission of :class:`~afm_rl.envs.CrazyflieTrack`.

    The observation holds the state (position in m, velocity in m/s, quaternion, body rate in rad/s)
    and the present reference (position, velocity), the action thrust (N) and moments (N m). The
    info holds the time (s), the squared error per axis of the last tick (m^2) and, as a truth
    hidden from the observation, ``regime_active``.

    Args:
        reference: a reference or the path of a CSV file; a circle if None.
        regime: regime parameters of the changed phase, or one mapping per phase.
        times: when phases begin (s); at 2 s and 5 s if None.
        ramp: ticks over which the regime changes; 0 for sudden changes.
        render_mode: None; there is nothing to see.
        settings: further arguments of :class:`~afm_rl.envs.CrazyflieTrack`.

    Raises:
        ConfigurationError: for a setting that cannot be used.
        NonFiniteError: at a step whose action is NaN or infinite.

    >>> import gymnasium, afm_rl  # registers the name
    >>> env = gymnasium.make("afm_rl/CrazyflieTrack-v0", regime={"mass": 0.5}, times=[2.0])
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, info["time"]
    ((19,), 0.0)
    """

    native: CrazyflieTrack
    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 20}

    def __init__(
        self,
        reference: Reference | str | Path | None = None,
        regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
        times: Sequence[float] | None = None,
        ramp: int = 0,
        render_mode: None = None,
        **settings: Any,
    ) -> None:
        if render_mode is not None:
            raise ConfigurationError(f"render_mode={render_mode!r}: expected none")
        missions = {"regime": regime, "ramp": ramp}
        tracks = "circle_2m_0.8mps" if reference is None else reference
        settings.setdefault("start", "moving")
        native = CrazyflieTrack(tracks, schedule=times, missions=missions, **settings)
        super().__init__(native, [np.inf] * 19)

    def _seen(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        info = {
            "time": data["step"].double() * self.native.simulation.dt,
            "square_error": data["square_error"],
            "regime_active": data["regime_active"],
        }
        return torch.cat([data["observation"], data["reference"][..., 0, :]], -1), info
