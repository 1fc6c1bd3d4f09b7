"""Methods of the suite: no correction, corrections, and an oracle."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import torch
from task import Task

from afm_rl import ActionFlowVectorWrapper
from afm_rl.comparison.episodes import Method
from afm_rl.comparison.robot import Robot
from afm_rl.correction import ActionFlow, L1Augmentation
from afm_rl.transforms.collect_then_fit import CollectThenFit

COMPARED = {name: name for name in ("least squares", "AFM", "oracle")} | {"without AFM": "none"}
"""Methods of ``afm_rl.compare``, by the names of the tables."""
METHODS = (
    *("without AFM", "least squares", "L1", "AFM", "AFM, up to 25 steps", "AFM, known delay"),
    *("AFM, soft start", "AFM, learned", "oracle"),
)
COLLECTING = 24  # healthy environments that a model is learned from, side by side


def method_of(name: str, task: Task, fault: str) -> tuple[Robot, Method]:
    """Return the robot with the model that a method has, and the method.

    Args:
        name: one of :data:`METHODS`.
        task: the task.
        fault: whose delay *AFM, known delay* is given.
    """
    robot = task.robot
    space: Any = robot.first.action_space
    box = [torch.from_numpy(end).double() for end in (space.low, space.high)]
    if name == "L1":
        return robot, L1Augmentation(*box, robot.dt)
    if name == "AFM, up to 25 steps":
        return robot, ActionFlow(*box, max_delay=25)
    if name == "AFM, soft start":
        return robot, ActionFlow(*box, max_delay=25, soft_start=0.2)
    if name == "AFM, known delay":
        return robot, ActionFlow(*box, delay=int(task.faults[fault].get("delay", 0)))
    if name == "AFM, learned":
        model, corrector = learned(task)
        return replace(robot, settings={"model": model}), corrector
    return robot, COMPARED[name]


@cache
def learned(task: Task) -> tuple[Any, Any]:
    """Return an ensemble that is fitted to healthy episodes of a policy, and its corrector."""
    healthy = ActionFlowVectorWrapper(task.robot.vector(COLLECTING), CollectThenFit())
    seeds = list(range(10_000, 10_000 + COLLECTING))
    act, (observations, infos) = task.begin(seeds), healthy.reset(seed=seeds)
    while not infos["afm"]["learned"].all():
        for _ in range(task.steps):
            observations = healthy.step(act(observations, {}))[0]
        observations, infos = healthy.reset()
    healthy.close()
    return healthy.collection.fitted, healthy._loop.corrector
