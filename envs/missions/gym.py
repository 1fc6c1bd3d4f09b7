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
        box, most = native.full_action_spec_unbatched["action"].space, np.array(bound, np.float32)
        low, high = (side.cpu().numpy().astype(np.float32) for side in (box.low, box.high))
        self.observation_space, self.action_space = Box(-most, most), Box(low, high)
        self._data: TensorDictBase | None = None

    @abstractmethod
    def _seen(self, data: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the observation and the info."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; ``seed`` restarts the noise, no seed continues it."""
        super().reset(seed=seed)
        if seed is not None or self._data is None:
            chosen = int(self.np_random.integers(2**31)) if seed is None else seed
            self.native.set_seed(chosen, static_seed=True)
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


def require_reset(data: TensorDictBase | None) -> TensorDictBase:
    """Return ``data``, which is None before the first reset."""
    if data is None:
        raise ResetNeeded("call reset() before step() or render()")
    return data
