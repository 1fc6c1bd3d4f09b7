"""A policy that others trained, and its task."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from faults import LATER

from afm_rl.comparison.policy import read_policy
from afm_rl.comparison.robot import Robot
from afm_rl.dynamics import KnownDynamics
from afm_rl.envs.task.rewards import pendulum_step
from afm_rl.planning import load_policy
from afm_rl.regimes import presets
from afm_rl.spaces.manifold import Manifold

POLICIES = Path(__file__).parents[3] / "examples" / "policies" / "zoo"
HEALTHY = 0.2  # share of an episode before the actuators fail


class Task:
    """A stored policy and the environment that it was trained for.

    Args:
        file: written by ``save_policy``; its description has the task's ``id`` and ``settings``.
        settings: other settings of the environment.

    Attributes:
        robot: the environment and its exact model.
        begin: returns what acts in episodes of so many seeds.
        faults: parameters of faults, by name.
        steps: of an episode.
        at: steps before the actuators fail.
    """

    def __init__(self, file: Path, **settings: Any) -> None:
        policy, about = load_policy(file)
        settings = about.get("settings", {}) | settings
        self.name = file.stem
        self.robot = Robot(about["id"], partial(gymnasium.make, about["id"], **settings))
        simulated = hasattr(self.robot.first.unwrapped, "data")
        self.robot.settings = {"model": "mujoco"} if simulated else PENDULUM
        self.begin = read_policy(policy, self.robot)
        self.faults = presets(self.robot.sizes[1]) | LATER
        self.steps = self.robot.limit
        self.at = round(HEALTHY * self.steps)


def _angle_and_speed(env: Any, observation: np.ndarray) -> np.ndarray:
    cosine, sine, speed = np.asarray(observation, dtype=np.float64)
    return np.array([np.arctan2(sine, cosine), speed])


def _observed(states: np.ndarray) -> np.ndarray:
    angle, speed = states.T
    return np.stack([np.cos(angle), np.sin(angle), speed], -1)


MODEL = KnownDynamics(pendulum_step, Manifold(2, angles=[0]), 1)
PENDULUM = {"model": MODEL, "state": _angle_and_speed, "observe": _observed}
