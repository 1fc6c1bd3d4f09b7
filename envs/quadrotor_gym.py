"""The quadrotor as a gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from tensordict import TensorDictBase

from afm_rl.envs.gym_adapter import require_reset
from afm_rl.envs.quadrotor import CrazyflieTrack
from afm_rl.envs.references import Reference
from afm_rl.errors import ConfigurationError


class CrazyflieTrackGym(gymnasium.Env):
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

    >>> import afm_rl  # registers the name
    >>> env = gymnasium.make("afm_rl/CrazyflieTrack-v0", regime={"mass": 0.5}, times=[2.0])
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, info["time"]
    ((19,), 0.0)
    """

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
        self.native = CrazyflieTrack(reference, schedule=times, missions=missions, **settings)
        box = self.native.action_spec.space
        low, high = (bound.cpu().numpy().astype(np.float32) for bound in (box.low, box.high))
        self.action_space = Box(low, high, dtype=np.float32)
        self.observation_space = Box(-np.inf, np.inf, (19,), dtype=np.float32)
        self._data: TensorDictBase | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin a flight; ``seed`` restarts the noise, no seed continues it."""
        super().reset(seed=seed)
        if seed is not None or self._data is None:
            chosen = int(self.np_random.integers(2**31)) if seed is None else seed
            self.native.set_seed(chosen, static_seed=True)
        self._data = self.native.reset()
        return self._described(self._data)

    def step(self, action: np.ndarray):
        """Hold thrust and moments for one control tick."""
        data = require_reset(self._data)
        data["action"] = torch.as_tensor(np.asarray(action), device=self.native.device)
        following = self.native.step(data)["next"]
        self._data = self.native.step_mdp(data)
        observation, info = self._described(following)
        ends = (bool(following[name]) for name in ("terminated", "truncated"))
        return observation, float(following["reward"]), *ends, info

    def _described(self, data: TensorDictBase) -> tuple[np.ndarray, dict[str, Any]]:
        seen = torch.cat([data["observation"], data["reference"][..., 0, :]], -1)
        info = {
            "time": data["step"].item() * self.native.simulation.dt,
            "square_error": data["square_error"].cpu().numpy(),
            "regime_active": data["regime_active"].item(),
        }
        return seen.cpu().numpy().astype(np.float32), info
