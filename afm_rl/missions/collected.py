"""Models of robots whose physics are not asked: learned from what their environment shows."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import cycle, islice
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, TransformedEnv

from afm_rl.compiling.devices import device_of
from afm_rl.dynamics import Ensemble
from afm_rl.learning import collect, fit_ensemble
from afm_rl.missions.robot import Collection, Robot
from afm_rl.planning import Cost, PlanningEnv
from afm_rl.regimes import Schedule


def transitions(
    robot: Robot,
    frames: int,
    seed: int,
    planner: TensorDictModuleBase | None = None,
    regimes: Sequence[Mapping[str, float]] = (),
    episodes: int = 8,
) -> TensorDictBase:
    """Return transitions by a planner or by random actions, under ``regimes`` by turns.

    ``episodes`` of them run at a time.
    """
    make = partial(
        robot.env,
        tracks=list(robot.tracks)[:1],
        regime=robot.regime,
        schedule=Schedule([]),  # one phase
        max_steps=frames,
        action_low=robot.action_low,
        action_high=robot.action_high,
        batch_size=[episodes],
        seed=10_000 * (seed + 1),  # missions are counted from 0
    )
    env = make()
    if regimes:
        turns = islice(cycle(regimes), episodes)
        env = make(missions=torch.stack([env.mission(regime=regime) for regime in turns]))
    env = env.to(device_of(robot.model))
    if planner is not None and hasattr(planner, "make_tensordict_primer"):
        env = TransformedEnv(env, Compose(planner.make_tensordict_primer()))
    logger = logging.getLogger("torchrl")  # tells of every buffer
    before = logger.level
    logger.setLevel(logging.WARNING)
    try:
        return collect(env, planner, frames, seed=10_000 * (seed + 1))[:]
    finally:
        logger.setLevel(before)


def fit_collected(model: Ensemble, robot: Robot, how: Collection, progress: bool) -> dict[str, Any]:
    """Collect transitions round by round and fit the model to all.

    Returns the last :class:`~afm_rl.learning.FitReport`, by name, and ``rewards``, the mean reward
    per step of each round.
    """
    cost = how.cost or Robot.known_reward
    cost = cost if isinstance(cost, Cost) else cost(robot)
    first, parts, planner = copy.deepcopy(model.state_dict()), [], None
    for number, frames in enumerate(how.rounds):
        with torch.no_grad():
            seed = how.seed + number
            parts.append(transitions(robot, frames, seed, planner, how.regimes))
        model.load_state_dict(first)
        settings = {"seed": how.seed, **how.fit, "progress": progress}
        report = fit_ensemble(model, torch.cat(parts), names=robot.state_names, **settings)
        planner = how.planner(PlanningEnv(model, cost, *robot.action_bounds, observe=robot.observe))
        if hasattr(planner, "bounds_key"):
            planner.bounds_key = None  # there is no correction that tells bounds
    rewards = [float(part["next", "reward"].mean()) for part in parts]
    return {**asdict(report), "rewards": rewards}
