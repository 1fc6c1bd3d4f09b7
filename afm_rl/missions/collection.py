"""How transitions are collected of robots whose physics are not asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tensordict.nn import TensorDictModuleBase

from afm_rl.errors import check_count, check_counts
from afm_rl.planning import Cost, PlanningEnv


@dataclass(frozen=True, kw_only=True)
class Collection:
    """How transitions are collected, with nominal dynamics if not told otherwise.

    Args:
        planner: makes a planner from a :class:`~afm_rl.planning.PlanningEnv`.
        rounds: transitions of each round: random actions first, then those of the planner, in the
            model that was learned from all rounds before.
        cost: to plan with, or what makes it from the robot; the robot's reward if None.
        fit: settings of :func:`~afm_rl.learning.fit_ensemble`.
        regimes: one for each episode of a round, by turns, from its first step on: domain
            randomisation. Parameters that are not named are nominal.
        seed: of the episodes.
    """

    planner: Callable[[PlanningEnv], TensorDictModuleBase]
    rounds: Sequence[int] = (2000, 1000)
    cost: Cost | Callable[[Any], Cost] | None = None
    fit: Mapping[str, Any] = field(default_factory=dict)
    regimes: Sequence[Mapping[str, float]] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        """Check counts.

        Raises:
            ConfigurationError: for numbers that cannot be used.
        """
        check_counts("robot.data.rounds", self.rounds, least=1)
        check_count("robot.data.seed", self.seed, low=0)
