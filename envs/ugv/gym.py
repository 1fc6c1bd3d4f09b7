"""The ground robot as an environment of gymnasium."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.courses.track import Track
from afm_rl.envs.missions.gym import MissionGym, require_reset
from afm_rl.envs.ugv.env import UGVTrack
from afm_rl.errors import check_choice
from afm_rl.imports import check_installed
from afm_rl.regimes import Regime, Schedule


class UGVTrackGym(MissionGym):
    """One mission of :class:`~afm_rl.envs.UGVTrack`.

    The observation is (x, y, theta, goal x, goal y) in m and rad, the action (v, omega) in m/s
    and rad/s. ``gymnasium.make`` adds the time limit of 5000 steps; the class itself has none.

    Args:
        track: ``ethz_1``, ``ethz_2``, the path of a CSV file, or a track.
        regime: regime parameters of the changed phase, or one mapping per phase.
        schedule: a schedule, or breakpoints of the progress; by default 0.15 and 0.80.
        ramp: steps over which the regime changes; 0 for sudden changes.
        family: regime family, which names the parameters; gains on v and omega if None.
        render_mode: None or ``"rgb_array"``.
        settings: further arguments of :class:`~afm_rl.envs.UGVTrack`.

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

    def __init__(
        self,
        track: str | Path | Track = "ethz_2",
        regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
        schedule: Schedule | Sequence[float] | None = None,
        ramp: int = 0,
        family: Regime | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        if render_mode is not None:
            check_choice("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        settings.setdefault("max_steps", 2**62)  # gymnasium limits time by a wrapper
        if schedule is not None and not isinstance(schedule, Schedule):
            schedule = Schedule(schedule)
        missions = {"regime": regime, "ramp": ramp}
        native = UGVTrack((track,), family, schedule, missions=missions, **settings)
        super().__init__(native, (np.inf, np.inf, np.pi, np.inf, np.inf))
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
        check_installed("render", "matplotlib")
        from afm_rl.envs.courses.rendering import canvas_of

        canvas = canvas_of(self.native.tracks[0])
        return canvas.draw(trail[-1], goal, trail, self.native.simulation.reach)

    def _seen(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        if self.render_mode is not None:
            self._trail.append(data["pose"])
        reached = data["reached"]
        progress = self.native.course.progress(data["mission", "track"], reached)
        info = {"reached": reached, "progress": progress, "regime_active": data["regime_active"]}
        return torch.cat([data["observation"], data["goal"]], -1), info
