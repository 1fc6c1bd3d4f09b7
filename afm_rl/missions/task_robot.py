"""A robot made from somebody else's task."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from afm_rl.dynamics import DynamicsModel, MuJoCoDynamics
from afm_rl.errors import ConfigurationError
from afm_rl.missions.robot import Collection, Robot
from afm_rl.missions.scores import ReturnScore
from afm_rl.regimes import Compose, Physics, Regime, Schedule, actuator_regimes
from afm_rl.trust import find_code


class TaskRobot(Robot):
    """A robot that is defined by a task.

    Regimes are those of :func:`~afm_rl.regimes.actuator_regimes`, the task's own ``changes`` and,
    in MuJoCo, :class:`~afm_rl.regimes.Physics`; each of these families can be selected by its
    name. By default the nominal model is the world of the task.

    Args:
        source: makes the task, an :class:`afm_rl.envs.Task`, from the ``settings``.
        make: makes the environment from the task.
        model: another nominal model.
        regime: another regime of the actions.
        schedule: times of the regime.
        physics: lowest and highest value of physical parameters that may change, by name: the
            family ``physics`` draws one of these; all if None.
        features: state coordinates that the dynamics depend on; those the task names if None.
        data: how transitions are collected for models that are learned; from the bounds of states
            and actions and the nominal model if None.
        settings: of the source; ``reward`` and ``step`` may be given as ``module.function``.

    Raises:
        ConfigurationError: if the model does not fit the task.
    """

    def __init__(
        self,
        source: Callable[..., Any],
        make: Callable[..., Any],
        model: DynamicsModel | None = None,
        regime: Regime | None = None,
        schedule: Schedule | None = None,
        physics: Mapping[str, Sequence[float]] | None = None,
        features: Sequence[int] | None = None,
        data: Collection | None = None,
        **settings: Any,
    ) -> None:
        task = source(**_with_code(settings))
        model = copy.deepcopy(task.world) if model is None else model
        sizes = model.state_size, model.action_size
        wanted = len(task.state_names), len(task.low)
        if sizes != wanted:
            raise ConfigurationError(
                f"robot.model: {sizes[0]} state coordinates and {sizes[1]} actions; expected "
                f"{wanted[0]} and {wanted[1]}, as {task.name} has them: "
                f"{', '.join((*task.state_names, *task.action_names))}"
            )
        low, high, first = list(task.low), list(task.high), task.start(0)[0].tolist()
        families = {**actuator_regimes(low, high), **task.changes}
        if isinstance(task.world, MuJoCoDynamics):
            families["physics"] = Physics(physics)
        schedule = Schedule([0.5]) if schedule is None else schedule
        named: dict[str, dict[str, Any]] = {name: {"draw": [name]} for name in families}
        named |= {
            name: {"list": [_phases(each, schedule.phases) for each in pairs]}
            for name, pairs in task.contexts.items()
        }
        prior = [["gain"], ["bias"], ["gain", "bias"]]
        super().__init__(
            name=task.name,
            state_names=task.state_names,
            action_names=task.action_names,
            action_low=low,
            action_high=high,
            state_low=[value - 1.0 for value in first],
            state_high=[value + 1.0 for value in first],
            features=list(task.features) if features is None else features,
            env=partial(make, task),
            model=model,
            regime=Compose(families, prior) if regime is None else regime,
            schedule=schedule,
            tracks=[task.name],
            families=named,
            score=ReturnScore(task.steps, task.goal_names),
            dt=task.dt,
            data=data,
            observe=task.observe,
            reward=task.planned,
            reward_reads={"goal": len(task.goal_names)} if task.goal_names else {},
        )


def _with_code(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with the functions that ``reward`` and ``step`` name."""
    named = {key: settings.get(key) for key in ("reward", "step")}
    code = {key: name for key, name in named.items() if isinstance(name, str)}
    return {**settings, **{key: find_code(f"robot.{key}", name) for key, name in code.items()}}


def _phases(regimes: Sequence[Mapping[str, float]], phases: int) -> list[Mapping[str, float]]:
    """Return the regime of each phase; of a single phase, the last one that is listed."""
    if phases == 1:
        return [regimes[-1]]
    return [*regimes, *[regimes[-1]] * phases][:phases]
