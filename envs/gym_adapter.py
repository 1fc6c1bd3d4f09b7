"""What the gymnasium adapters share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.mission_env import MissionEnv
from afm_rl.envs.track import Track
from afm_rl.envs.ugv import UGVTrack
from afm_rl.regimes import Regime, Schedule

UGV_BOUND = (np.inf, np.inf, np.pi, np.inf, np.inf)  # x, y, theta, goal x, goal y


class MissionGym(gymnasium.Env):
    """One mission of a native environment.

    Args:
        native: the environment.
        bound: largest size of each number of the observation.
    """

    def __init__(self, native: MissionEnv, bound: Sequence[float]) -> None:
        self.native = native
        self.observation_space, self.action_space = spaces(native, bound)
        self._data: TensorDictBase | None = None

    @abstractmethod
    def _seen(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the observation and the info."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; ``seed`` restarts the noise, no seed continues it."""
        super().reset(seed=seed)
        reseed(self.native, self.np_random, seed, self._data)
        self._data = self.native.reset()
        return self._described(self._data)

    def step(self, action: np.ndarray):
        data = require_reset(self._data)
        data["action"] = torch.as_tensor(np.asarray(action), device=self.native.device)
        following = self.native.step(data)["next"]
        self._data = self.native.step_mdp(data)
        ends = (bool(following[name]) for name in ("terminated", "truncated"))
        observation, info = self._described(following)
        return observation, float(following["reward"]), *ends, info

    def _described(self, data: TensorDictBase) -> tuple[np.ndarray, dict[str, Any]]:
        seen, info = self._seen(data)
        plain = {k: v.cpu().numpy() if v.dim() else v.item() for k, v in info.items()}
        return seen.cpu().numpy().astype(np.float32), plain


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


def spaces(env: MissionEnv, bound: Sequence[float]) -> tuple[Box, Box]:
    """Return the observation space and the action space of one mission."""
    box = env.full_action_spec_unbatched["action"].space
    low, high = (side.cpu().numpy().astype(np.float32) for side in (box.low, box.high))
    most = np.array(bound, dtype=np.float32)
    return Box(-most, most, dtype=np.float32), Box(low, high, dtype=np.float32)


def reseed(env: MissionEnv, random, seed: int | None, data: TensorDictBase | None) -> None:
    """Restart the noise where a ``seed`` is given, and before the first reset."""
    if seed is not None or data is None:
        chosen = int(random.integers(2**31)) if seed is None else seed
        env.set_seed(chosen, static_seed=True)


def require_reset(data: TensorDictBase | None) -> TensorDictBase:
    """Return ``data``, which is None before the first reset.

    Raises:
        gymnasium.error.ResetNeeded: if it is None.
    """
    if data is None:
        raise ResetNeeded("call reset() before step() or render()")
    return data


def observe_ugv(env: UGVTrack, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the observation ``(*B, 5)`` and the info of each mission.

    The info holds the number of targets ``reached``, the ``progress`` in [0, 1], and, as a
    truth hidden from the observation, ``regime_active``.
    """
    reached = data["reached"]
    progress = env.course.progress(data["mission", "track"], reached)
    info = {"reached": reached, "progress": progress, "regime_active": data["regime_active"]}
    return torch.cat([data["observation"], data["goal"]], -1), info
