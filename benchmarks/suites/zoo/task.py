"""A policy that others trained, and its task, many times side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from faults import LATER
from gymnasium.vector import SyncVectorEnv

from afm_rl.envs.task.rewards import pendulum_step
from afm_rl.planning import load_policy
from afm_rl.regimes import presets

POLICIES = Path(__file__).parents[3] / "examples" / "policies" / "zoo"
HEALTHY = 0.2  # share of an episode before the actuators fail


class Task:
    """A stored policy and the environment that it was trained for.

    Args:
        file: written by ``save_policy``; its description has the task's ``id`` and ``settings``.
    """

    def __init__(self, file: Path) -> None:
        self.name = file.stem
        self.policy, about = load_policy(file)
        self.id, self.settings = about["id"], about.get("settings", {})
        self.home = None
        self.twin = self.make()
        self.steps = self.twin.spec.max_episode_steps
        self.at = round(HEALTHY * self.steps)
        space = self.twin.action_space
        self.low, self.high = (torch.from_numpy(end).double() for end in (space.low, space.high))
        self.faults = presets(len(space.low)) | LATER
        self.twin.reset(seed=0)

    def make(self) -> gymnasium.Env:
        """Return a new environment."""
        return gymnasium.make(self.id, **self.settings)

    def vector(self, count: int) -> SyncVectorEnv:
        """Return ``count`` environments."""
        return SyncVectorEnv([self.make] * count)

    def begin(self, count: int) -> None:
        """Have the policy act in so many environments from their start."""

    def act(self, observations: np.ndarray, infos: Any = None) -> np.ndarray:
        """Return the policy's actions ``(N, A)``; infos tell policies with a clock the delay."""
        return self.policy(torch.as_tensor(observations, dtype=torch.float32)).numpy()

    @property
    def model(self) -> Any:
        """The exact model, as the wrapper takes it."""
        return {"model": "mujoco"} if hasattr(self.twin.unwrapped, "data") else PENDULUM

    def after(self, env: Any, effects: np.ndarray) -> np.ndarray:
        """Return what is seen after effects ``(D, A)`` from where ``env`` is now."""
        here, twin = env.unwrapped, self.twin.unwrapped
        if hasattr(here, "data"):
            twin.set_state(here.data.qpos, here.data.qvel)
        else:
            twin.state = np.array(here.state)
        for effect in effects:
            observation, *_ = twin.step(effect.astype(self.twin.action_space.dtype))
        return observation


def _angle_and_speed(envs: Any, observations: np.ndarray) -> np.ndarray:
    cosine, sine, speed = np.asarray(observations, dtype=np.float64).T
    return np.stack([np.arctan2(sine, cosine), speed], -1)


def _observed(states: np.ndarray) -> np.ndarray:
    angle, speed = states.T
    return np.stack([np.cos(angle), np.sin(angle), speed], -1)


PENDULUM = {"model": pendulum_step, "state": _angle_and_speed, "observe": _observed}
