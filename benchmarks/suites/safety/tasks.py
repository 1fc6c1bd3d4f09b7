"""Policies that others trained, in MuJoCo worlds that differ from the model."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorWrapper

from afm_rl import ActionFlowVectorWrapper

ZOO = Path(__file__).parents[1] / "zoo"
POLICIES = Path(__file__).parents[3] / "examples" / "policies" / "zoo"
ROBOTS = ("half_cheetah_tqc", "hopper_trpo", "swimmer_trpo")
PUSHED = 60  # step

CHANGES: dict[str, dict[str, float]] = {
    "healthy": {},
    "push 0.5": {"push": 0.5},
    "push 2": {"push": 2.0},
    "gusts 0.02": {"gust": 0.02},
    "gusts 0.1": {"gust": 0.1},
    "mass x 1.2": {"mass": 1.2},
    "mass x 0.8": {"mass": 0.8},
    "gravity x 1.1": {"gravity": 1.1},
    "friction x 0.7": {"friction": 0.7},
    "damping x 1.3": {"damping": 1.3},
}


class Disturbed(VectorWrapper):
    """Environments that are pushed, one rule each."""

    def __init__(self, env: SyncVectorEnv, rules: list[dict[str, float]], seeds: int) -> None:
        super().__init__(env)
        self.rules, self.seeds = rules, seeds

    def change(self) -> None:
        """Apply the rules to the worlds, after the model was copied."""
        for env, rule in zip(self.env.envs, self.rules, strict=True):
            model = env.unwrapped.model
            model.opt.gravity[:] *= rule.get("gravity", 1.0)
            model.body_mass[:] *= rule.get("mass", 1.0)
            model.body_inertia[:] *= rule.get("mass", 1.0)
            model.geom_friction[:] *= rule.get("friction", 1.0)
            model.dof_damping[:] *= rule.get("damping", 1.0)

    def reset(self, **options: Any):
        """Begin with the random numbers of each seed."""
        self.random = [np.random.default_rng(k % self.seeds) for k in range(len(self.rules))]
        self.time = 0
        return self.env.reset(**options)

    def step(self, actions: Any):
        """Push, and make a step."""
        for env, rule, random in zip(self.env.envs, self.rules, self.random, strict=True):
            speed = env.unwrapped.data.qvel
            speed += rule.get("gust", 0.0) * random.standard_normal(len(speed))
            if self.time == PUSHED:
                speed += rule.get("push", 0.0) * random.standard_normal(len(speed))
        self.time += 1
        return self.env.step(actions)


def play(name: str, corrected: bool, seeds: int, steps: int = 300) -> np.ndarray:
    """Return the mean cost a step, minus the reward, ``(changes, seeds)``."""
    sys.path.insert(0, str(ZOO))
    from task import Task  # the suite beside this one

    task = Task(POLICIES / f"{name}.safetensors")
    rules = [rule for rule in CHANGES.values() for _ in range(seeds)]
    world = Disturbed(task.robot.vector(len(rules)), rules, seeds)
    settings = task.robot.vector_settings
    envs: Any = ActionFlowVectorWrapper(world, **settings) if corrected else world
    starts = [k % seeds for k in range(len(rules))]
    act, (observations, _) = task.begin(starts), envs.reset(seed=starts)
    world.change()
    total, alive = np.zeros(len(rules)), np.ones(len(rules), dtype=bool)
    for _ in range(steps):
        observations, rewards, terminated, truncated, _ = envs.step(act(observations, {}))
        total += rewards * alive
        alive &= ~(terminated | truncated)
    return -total.reshape(len(CHANGES), seeds) / steps
