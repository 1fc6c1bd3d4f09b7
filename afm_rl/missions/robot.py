"""What the library must know of a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from annotated_types import MinLen
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_indices, check_number
from afm_rl.missions.scores import LapScore, Score
from afm_rl.options import Count, Natural, Positive, options
from afm_rl.planning import Cost, PlanningEnv
from afm_rl.planning.costs import KnownReward
from afm_rl.regimes import Regime, Schedule


@options("robot.data")
@dataclass(frozen=True, kw_only=True)
class Collection:
    """How transitions are collected, by default with nominal dynamics.

    The actions of the first round are random. In later rounds the planner acts, with the model
    learned from all earlier rounds.

    Args:
        planner: makes a planner from a :class:`~afm_rl.planning.PlanningEnv`.
        cost: cost for planning, or a function that makes it from the robot; the robot's reward if
            None.
        fit: settings of :func:`~afm_rl.learning.fit_ensemble`.
        regimes: regimes of the episodes of a round, in turn, from the first step on (domain
            randomisation). Other parameters are nominal.
    """

    planner: Callable[[PlanningEnv], TensorDictModuleBase]
    rounds: Annotated[Sequence[Count], MinLen(1), "number of transitions per round"] = (2000, 1000)
    cost: Cost | Callable[[Any], Cost] | None = None
    fit: Mapping[str, Any] = field(default_factory=dict)
    regimes: Sequence[Mapping[str, float]] = ()
    seed: Annotated[Natural, "seed of the episodes"] = 0


SHAPE_TRAINING = (
    *("action_low", "action_high", "state_low", "state_high"),
    *("features", "model", "regime", "usual_low", "usual_high"),
    *("source", "domain", "task", "id", "xml", "reward", "step", "frame_skip", "start", "angles"),
    *("start_noise", "steps", "data"),
)
"""What training data depend on."""


@options("robot")
@dataclass(frozen=True, kw_only=True)
class Robot:
    """A robot: its environment, nominal physics, regimes and bounds.

    Args:
        name: short name.
        state_names: names of the state coordinates, for tables.
        goal_names: names of the goal's coordinates, among those of the state; none without a goal.
        action_names: names of the action components.
        action_low: lowest action.
        action_high: highest action.
        state_low: lowest state from which training states are drawn.
        state_high: highest one.
        features: indices of the state coordinates that the dynamics depend on; all if none.
        env: makes the environment from ``tracks``, ``regime``, ``schedule``, ``max_steps``
            and the action bounds.
        model: nominal physics.
        regime: family of regimes.
        schedule: when regimes start and end.
        tracks: names of all tracks, or of other variants of missions.
        paper_regimes: the regimes of the published study.
        families: regimes from which every seed draws its own parameters, by name; see
            :class:`~afm_rl.missions.selection.Family`.
        score: the metrics of missions; targets reached if None.
        usual_low: lowest corner of the usual range of actions, the unit of calibrations
            and the range in which residual networks are trained; the action bounds if None.
        usual_high: highest one.
        context_coordinates: indices of the state coordinates (m) on which faults may depend,
            such as the position on the ground; none by default.
        reward: the reward of its task, ``reward(state, action, next_state, *task)``, if it has one
            to plan with; see :class:`~afm_rl.planning.KnownReward`.
        reward_reads: entries of the environment that it reads after the states, with their sizes.
        observe: function from states ``(*B, S)`` to observations of a policy ``(*B, O)``; the
            states if None.
        reported: entry of the environment with the action that its actuators produced, if it
            differs from the command; learners and correctors then read this entry.
        data: how transitions for learned models are collected; None: drawn from the nominal
            physics, within the bounds above.
    """

    name: str
    state_names: Sequence[str]
    action_names: Sequence[str]
    action_low: Sequence[float]
    action_high: Sequence[float]
    state_low: Sequence[float]
    state_high: Sequence[float]
    env: Callable[..., EnvBase]
    model: DynamicsModel
    regime: Regime
    goal_names: Sequence[str] = ()
    features: Sequence[int] = ()
    schedule: Schedule = field(default_factory=Schedule)
    tracks: Sequence[str] = ("default",)
    paper_regimes: Sequence[Mapping[str, float]] = ()
    families: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    score: Score | None = None
    usual_low: Sequence[float] | None = None
    usual_high: Sequence[float] | None = None
    context_coordinates: Sequence[int] = ()
    reward: Callable[..., Tensor] | None = None
    reward_reads: Mapping[str, int] = field(default_factory=dict)
    observe: Callable[[Tensor], Tensor] | None = None
    dt: Annotated[Positive | None, "duration of an action, s, for correctors that need it"] = None
    reported: str | None = None
    data: Collection | None = None

    def __post_init__(self) -> None:
        """Check that bounds, names and features fit the model."""
        for kind, size in (("action", self.model.action_size), ("state", self.model.state_size)):
            self._check_bounds(kind, size)
            names = list(getattr(self, f"{kind}_names"))
            if len(set(names)) < len(names) or len(names) != size:
                raise ConfigurationError(
                    f"robot.{kind}_names={names}: expected {size} names, each once"
                )
        goals = list(self.goal_names)
        if len(set(goals)) < len(goals) or not set(goals) <= set(self.state_names):
            raise ConfigurationError(
                f"robot.goal_names={goals}: expected some of {', '.join(self.state_names)}"
            )
        size = self.model.state_size
        if not self.features:
            object.__setattr__(self, "features", tuple(range(size)))
        for name in ("features", "context_coordinates"):
            check_indices(f"robot.{name}", getattr(self, name), size)

        if self.usual_low is not None or self.usual_high is not None:
            self._check_bounds("usual", self.model.action_size)
        if self.score is not None and not isinstance(self.score, Score):
            raise ConfigurationError(f"robot.score={self.score!r}: expected a Score, or null")

    def _check_bounds(self, kind: str, size: int) -> None:
        low, high = (
            [check_number(f"robot.{kind}_{end}", x) for x in getattr(self, f"{kind}_{end}") or ()]
            for end in ("low", "high")
        )
        fits = len(low) == len(high) == size
        if not fits or any(a > b for a, b in zip(low, high, strict=True)):
            raise ConfigurationError(
                f"robot.{kind}_low={list(low)}, robot.{kind}_high={list(high)}: expected "
                f"{size} numbers each, low <= high"
            )

    def known_reward(self) -> KnownReward:
        """Return the cost that is the negative reward of the task.

        Raises:
            ConfigurationError: if there is none.
        """
        if self.reward is None:
            raise ConfigurationError(
                f"cost=reward: robot={self.name} has no reward; choose another cost, such as "
                "goal_position, or a robot with a task: gymnasium, dm_control or mujoco"
            )
        return KnownReward(self.reward, list(self.reward_reads), list(self.reward_reads.values()))

    @property
    def metrics(self) -> Score:
        """The measures of missions."""
        return LapScore() if self.score is None else self.score

    @property
    def usual_bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest usual action, ``(A,)`` each."""
        if self.usual_low is None:
            return self.action_bounds
        return torch.tensor(self.usual_low), torch.tensor(self.usual_high)

    @property
    def action_bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest action, ``(A,)`` each."""
        return torch.tensor(self.action_low), torch.tensor(self.action_high)

    @property
    def state_bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest training state, ``(S,)`` each."""
        return torch.tensor(self.state_low), torch.tensor(self.state_high)
