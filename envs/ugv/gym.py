"""The ground robot as gymnasium environments: one mission, or a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.courses.rendering import canvas_of
from afm_rl.envs.courses.track import Track
from afm_rl.envs.missions.gym import MissionGym, require_reset, reseed, spaces
from afm_rl.envs.ugv.env import UGVTrack
from afm_rl.errors import ConfigurationError, check_choice, check_count
from afm_rl.regimes import Regime, Schedule

UGV_BOUND = (np.inf, np.inf, np.pi, np.inf, np.inf)  # x, y, theta, goal x, goal y


class UGVTrackGym(MissionGym):
    """One mission of :class:`~afm_rl.envs.UGVTrack`.

    The observation is (x, y, theta, goal x, goal y) in m and rad, the action (v, omega) in m/s
    and rad/s. ``gymnasium.make`` adds the time limit of 5000 steps; the class itself has none.

    Args:
        render_mode: None or ``"rgb_array"``.
        settings: of :func:`~afm_rl.envs.ugv.gym.build_ugv`: ``track``, ``regime``,
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


def build_ugv(
    track: str | Path | Track = "ethz_2",
    regime: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
    schedule: Schedule | Sequence[float] | None = None,
    ramp: int = 0,
    family: Regime | None = None,
    **settings: Any,
) -> UGVTrack:
    """Return the ground robot, with the same regime for every mission.

    Args:
        track: ``ethz_1``, ``ethz_2``, the path of a CSV file, or a track.
        regime: regime parameters of the changed phase, or one mapping per phase.
        schedule: a schedule, or breakpoints of the progress; by default 0.15 and 0.80.
        ramp: steps over which the regime changes; 0 for sudden changes.
        family: regime family, which names the parameters; gains on v and omega if None.
        settings: further arguments of :class:`~afm_rl.envs.UGVTrack`.

    Raises:
        ConfigurationError: for a setting that cannot be used.
    """
    if schedule is not None and not isinstance(schedule, Schedule):
        schedule = Schedule(schedule)
    missions = {"regime": regime, "ramp": ramp}
    return UGVTrack((track,), family, schedule, missions=missions, **settings)


def observe_ugv(env: UGVTrack, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the observation ``(*B, 5)`` and the info of each mission, in part hidden truth."""
    reached = data["reached"]
    progress = env.course.progress(data["mission", "track"], reached)
    info = {"reached": reached, "progress": progress, "regime_active": data["regime_active"]}
    return torch.cat([data["observation"], data["goal"]], -1), info


class UGVTrackVectorEnv(VectorEnv):
    """Several missions of :class:`~afm_rl.envs.UGVTrack` in one batch.

    Mission ``i`` meets the same noise as :class:`~afm_rl.envs.ugv.gym.UGVTrackGym` reset with
    ``seed + i``. A mission that ends is reset in the same step, and its last observation is in
    ``info["final_obs"]``; or, with ``autoreset_mode=AutoresetMode.DISABLED``, it waits for
    ``reset(options={"reset_mask": ...})``.

    Args:
        num_envs: number of missions.
        autoreset_mode: ``AutoresetMode.SAME_STEP`` or ``AutoresetMode.DISABLED``.
        max_episode_steps: steps after which an episode is truncated.
        render_mode: None or ``"rgb_array"``.
        settings: see :class:`~afm_rl.envs.ugv.gym.UGVTrackGym`.

    Raises:
        ConfigurationError: for a setting that cannot be used.
        NonFiniteError: at a step with an action that is NaN or infinite.

    >>> env = UGVTrackVectorEnv(num_envs=3, track="ethz_1")
    >>> env.reset(seed=0)[0].shape
    (3, 5)
    """

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        max_episode_steps: int = 5000,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        if render_mode is not None:
            check_choice("render_mode", render_mode, self.metadata["render_modes"])
        if autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise ConfigurationError(
                f"autoreset_mode={autoreset_mode!r}: expected AutoresetMode.SAME_STEP or DISABLED"
            )
        self.render_mode = render_mode
        self.autoreset_mode = autoreset_mode
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self.num_envs = check_count("num_envs", num_envs)
        settings.setdefault("max_steps", max_episode_steps)
        self.native = build_ugv(batch_size=(self.num_envs,), **settings)
        self.single_observation_space, self.single_action_space = spaces(self.native, UGV_BOUND)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._data: TensorDictBase | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Reset all missions, or those in ``options["reset_mask"]`` (booleans ``(N,)``)."""
        super().reset(seed=seed)
        reseed(self.native, self.np_random, seed, self._data)
        mask = (options or {}).get("reset_mask")
        if mask is None or self._data is None:
            self._data = self.native.reset()
        else:
            self._data = self._restarted(self._data, np.asarray(mask))
        return self._described(self._data)

    def step(self, actions: np.ndarray):
        """Apply the actions ``(N, 2)`` for one time step."""
        data = require_reset(self._data)
        data["action"] = torch.as_tensor(np.asarray(actions), device=self.native.device)
        following = self.native.step(data)["next"]
        self._data = self.native.step_mdp(data)
        observation, info = self._described(following)
        reward, terminated, truncated, done = (
            following[name].squeeze(-1).cpu().numpy()
            for name in ("reward", "terminated", "truncated", "done")
        )
        if done.any() and self.autoreset_mode is AutoresetMode.SAME_STEP:
            final = np.full(self.num_envs, None, dtype=object)
            for mission in np.flatnonzero(done):
                final[mission] = observation[mission]
            masked = {name: done.copy() for name in info if name.startswith("_")}
            final_info = info | masked
            self._data = self._restarted(self._data, done)
            observation, info = self._described(self._data)
            info |= {"final_obs": final, "_final_obs": done.copy()}
            info |= {"final_info": final_info, "_final_info": done.copy()}
        return observation, reward.astype(np.float64), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw each mission, ``(H, W, 3)`` bytes."""
        if self.render_mode is None:
            return None
        canvas, reach = canvas_of(self.native.tracks[0]), self.native.simulation.reach
        data = require_reset(self._data)
        pairs = zip(data["pose"], data["goal"], strict=True)
        return tuple(canvas.draw(pose, goal, reach=reach) for pose, goal in pairs)

    def _restarted(self, data: TensorDictBase, mask: np.ndarray) -> TensorDictBase:
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ConfigurationError(
                f"reset_mask {mask.dtype}{mask.shape}: expected booleans ({self.num_envs},)"
            )
        data["_reset"] = torch.as_tensor(mask, device=self.native.device).unsqueeze(-1)
        return self.native.reset(data, set_state=False)

    def _described(self, data: TensorDictBase) -> tuple[np.ndarray, dict[str, Any]]:
        """Return observation and info, with gymnasium's mask for each entry of the info."""
        seen, truth = observe_ugv(self.native, data)
        observation = seen.cpu().numpy().astype(np.float32)
        info = {name: value.cpu().numpy() for name, value in truth.items()}
        everyone = {f"_{name}": np.ones(self.num_envs, dtype=np.bool_) for name in info}
        return observation, info | everyone
