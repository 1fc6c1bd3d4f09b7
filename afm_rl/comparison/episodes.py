"""Episodes whose actuators fail, side by side, and how soon their rewards are as before."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.vector import VectorEnv

from afm_rl.comparison.oracle import Oracle
from afm_rl.comparison.policy import Acting, Policy
from afm_rl.comparison.robot import Robot
from afm_rl.correction import Corrector, LeastSquares
from afm_rl.errors import ConfigurationError, check_choice
from afm_rl.progress import Bar
from afm_rl.regimes.presets import Fault
from afm_rl.transforms.fault_wrapper import FaultVectorWrapper
from afm_rl.transforms.gymnasium import ActionFlowVectorWrapper

WINDOW, MISSING = 2.0, 0.1  # s; share of the healthy reward
WINDOW_STEPS = 40  # where the environment does not say how long a step is
LASTS = 0.25  # share of the rest of an episode for which a recovery lasts at least
METHODS = ("none", "AFM", "least squares", "oracle")
Method = str | Corrector


class Played(NamedTuple):
    """Rewards of episodes, and how they ended."""

    rewards: np.ndarray
    """``(T, N)``; 0 after the end of an episode."""
    lasted: np.ndarray
    """Steps, ``(N,)``."""
    fell: np.ndarray
    """Did the environment end the episode, other than by its time limit? ``(N,)``."""


def play(
    robot: Robot,
    policy: Policy,
    method: Method,
    faults: Sequence[Fault],
    seeds: Sequence[int],
    at: int,
    steps: int,
    bar: Bar | None = None,
    names: Sequence[str] = (),
) -> Played:
    """Play N episodes in one batch.

    Args:
        robot: the robot.
        policy: what :func:`~afm_rl.comparison.policy.read_policy` returned.
        method: one of :data:`METHODS`, or a corrector.
        faults: of each episode.
        seeds: of each episode.
        at: steps before the fault.
        steps: of an episode, at most.
        bar: shows the progress, and the ``names`` of what still runs.
        names: of the faults of each episode.
    """
    torch.manual_seed(0)
    inner = FaultVectorWrapper(robot.vector(len(seeds)), faults, at, robot.home)
    envs, act = corrected(robot, inner, policy(seeds), method)
    starts: Any = [*seeds]
    observations, infos = envs.reset(seed=starts)
    rewards, alive = np.zeros((steps, len(seeds))), np.ones(len(seeds), dtype=bool)
    lasted, fell = np.zeros(len(seeds), dtype=int), np.zeros(len(seeds), dtype=bool)
    for step in range(steps):
        observations, reward, terminated, truncated, infos = envs.step(act(observations, infos))
        rewards[step] = np.where(alive, reward, 0.0)
        lasted += alive
        fell |= alive & terminated
        alive &= ~(terminated | truncated)
        if bar is not None:
            running = dict.fromkeys(np.array(names)[alive])
            bar.set_postfix_str(", ".join(running)[:80], refresh=False)
            bar.update(1 if alive.any() else steps - step)
        if not alive.any():
            break
    envs.close()
    return Played(rewards, lasted, fell)


def corrected(
    robot: Robot, envs: FaultVectorWrapper, act: Acting, method: Method
) -> tuple[VectorEnv, Acting]:
    """Return environments with a method around them, and what acts in them."""
    if method == "none":
        return envs, act
    if method == "oracle":
        return envs, Oracle(robot, envs, act)
    corrector = deepcopy(method) if isinstance(method, Corrector) else None
    if method == "least squares":
        space: Any = envs.single_action_space
        low, high = (torch.from_numpy(end).double() for end in (space.low, space.high))
        corrector = LeastSquares(low, high, form="gain_offset")
    return ActionFlowVectorWrapper(envs, corrector=corrector, **robot.vector_settings), act


def read_methods(methods: Any) -> dict[str, Method]:
    """Return methods by name, no correction first.

    Args:
        methods: names, correctors, or either by a name of your own.

    Raises:
        ConfigurationError: for anything else, or two correctors of one name.
    """
    if isinstance(methods, str | Corrector):
        methods = [methods]
    if not isinstance(methods, dict):
        pairs = [(m if isinstance(m, str) else type(m).__name__, m) for m in methods]
        if len(dict(pairs)) < len(pairs):
            raise ConfigurationError(
                f"compare: methods: {', '.join(name for name, _ in pairs)}: the same name twice; "
                "give a dictionary, such as {'mine': corrector}"
            )
        methods = dict(pairs)
    for name, method in methods.items():
        if not isinstance(method, Corrector):
            check_choice(f"compare: method {name}", method, METHODS)
    return {"none": "none", **methods}


def rows_of(
    played: Played, cases: Sequence[tuple[str, int]], at: int, level: float, window: int
) -> list[dict[str, Any]]:
    """Return a row of results for each episode, by the columns of ``Comparison.episodes``.

    Args:
        played: N episodes.
        cases: fault and seed of each.
        at: steps before the fault.
        level: reward a step of a healthy robot, as :func:`usual` says.
        window: over how many steps rewards are averaged.
    """
    rows = []
    columns = zip(cases, played.rewards.T, played.lasted, played.fell, strict=True)
    for (fault, seed), rewards, lasted, fell in columns:
        row: dict[str, Any] = {"fault": fault, "seed": seed}
        row |= {"before": rewards[:at].sum(), "after": rewards[at:].sum()}
        row |= {"survived": not fell, "lasted": int(lasted)}
        rows.append(row | {"recovered": recovered(rewards[at:], level, window)})
    return rows


def usual(rewards: np.ndarray, window: int) -> float:
    """Return the reward a step that healthy runs ``(T, N)`` never miss by more than a tenth.

    It is that of their worst window, less a tenth of their mean.

    >>> round(usual(np.ones((50, 2)), window=10), 6)
    0.9
    """
    worst = min(means(mine, window).min() for mine in rewards.T)
    return float(worst - MISSING * abs(rewards.mean()))


def recovered(rewards: np.ndarray, level: float, window: int) -> float:
    """Return after how many steps no window of the rewards ``(T,)`` has a mean below ``level``.

    Infinity where that lasts for less than a quarter of all windows.

    >>> recovered(np.r_[np.zeros(5), np.ones(20)], level=0.9, window=4)
    5.0
    """
    over = means(rewards, window)
    low = np.flatnonzero(over < level)
    start = 0 if not len(low) else int(low[-1]) + 1
    return float(start) if len(over) - start >= LASTS * len(over) else math.inf


def means(values: np.ndarray, window: int) -> np.ndarray:
    """Return the means of all windows of values ``(T,)``."""
    return np.convolve(values, np.full(window, 1 / window), "valid")


def window_of(robot: Robot, steps: int) -> int:
    """Return over how many of ``steps`` rewards are averaged: 2 s, or 40."""
    return max(1, min(round(WINDOW / robot.dt) if robot.dt else WINDOW_STEPS, steps))
