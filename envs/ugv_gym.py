"""The ground robot as a gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.gym_adapter import (
    UGV_BOUND,
    MissionGym,
    build_ugv,
    observe_ugv,
    require_reset,
)
from afm_rl.envs.rendering import canvas_of
from afm_rl.envs.ugv import UGVTrack
from afm_rl.errors import check_choice


class UGVTrackGym(MissionGym):
    """One mission of :class:`~afm_rl.envs.UGVTrack`.

    The observation is (x, y, theta, goal x, goal y) in m and rad, the action (v, omega) in m/s
    and rad/s. ``gymnasium.make`` adds the time limit of 5000 steps; the class itself has none.

    Args:
        render_mode: None or ``"rgb_array"``.
        settings: of :func:`~afm_rl.envs.gym_adapter.build_ugv`: ``track``, ``regime``,
            ``schedule``, ``ramp``, ``family``, and those of :class:`~afm_rl.envs.UGVTrack`.

    Raises:
        ConfigurationError: for a setting that cannot be used.
        NonFiniteError: at a step whose action is NaN or infinite.

    >>> import afm_rl  # registers the name
    >>> env = gymnasium.make("afm_rl/UGVTrack-v0", regime={"v_gain": -1.0})
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, info["reached"]
    ((5,), 0)
    """

    native: UGVTrack
    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        if render_mode is not None:
            check_choice("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        settings.setdefault("max_steps", 2**62)  # gymnasium limits time by a wrapper
        super().__init__(build_ugv(**settings), UGV_BOUND)
        self._trail: list[Tensor] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        self._trail = []
        return super().reset(seed=seed, options=options)

    def render(self) -> np.ndarray | None:
        """Draw the robot, its goal and its trail, ``(H, W, 3)`` bytes."""
        if self.render_mode is None:
            gymnasium.logger.warn('render() draws nothing: make it with render_mode="rgb_array"')
            return None
        goal, trail = require_reset(self._data)["goal"], torch.stack(self._trail)
        canvas = canvas_of(self.native.tracks[0])
        return canvas.draw(trail[-1], goal, trail, self.native.simulation.reach)

    def _seen(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        if self.render_mode is not None:
            self._trail.append(data["pose"])
        return observe_ugv(self.native, data)
