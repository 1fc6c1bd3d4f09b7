"""One mission as a gymnasium environment, and what its adapters share."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from tensordict import TensorDictBase
from torch import Tensor

from afm_rl.envs.missions.env import MissionEnv


class MissionGym(gymnasium.Env):
    """One mission of a native environment; ``bound`` is the largest size of what is observed."""

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
    """Return ``data``, which is None before the first reset."""
    if data is None:
        raise ResetNeeded("call reset() before step() or render()")
    return data
