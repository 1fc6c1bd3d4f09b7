"""What is logged of a kind of mission, and the measures by which methods are compared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from afm_rl.errors import ConfigurationError
from afm_rl.storage.measures import Measures


class Score(ABC):
    """What is logged of a kind of mission, what is summed up, and what its table says.

    Attributes:
        measures: the columns of :meth:`table` by which methods are compared. Runs store them with
            their results, and reports know nothing else of a kind of mission.
        columns: names of the numbers that :meth:`row` logs, the last columns of the steps.
        whole: those that are whole numbers.
        reads: entries of the environment without which there is no score.
    """

    measures: ClassVar[Measures]
    columns: Sequence[str] = ()
    whole: Sequence[str] = ()
    reads: Sequence[str] = ()

    def check(self, env: EnvBase, goal_names: Sequence[str]) -> None:
        """Check that the environment gives what the score reads.

        Raises:
            ConfigurationError: otherwise, or if there are not as many names as goal coordinates.
        """
        missing = [key for key in self.reads if key not in env.observation_spec.keys()]
        if missing:
            raise ConfigurationError(
                f"robot.score={type(self).__name__}: reads {', '.join(self.reads)}, but the "
                f"environment gives no {', '.join(missing)}"
            )
        size = self.goal(env.observation_spec.zero()).shape[-1]
        if len(goal_names) != size:
            raise ConfigurationError(f"robot.goal_names={list(goal_names)}: expected {size} names")

    @abstractmethod
    def goal(self, td: TensorDictBase) -> Tensor:
        """Return where missions are to go now, ``(*B, G)``."""

    @abstractmethod
    def row(self, td: TensorDictBase) -> Tensor:
        """Return what is logged of a step with its outcome, ``(B, C)``."""

    @abstractmethod
    def start(self, missions: TensorDictBase) -> dict[str, Tensor]:
        """Return the sums before the first step, a row for every mission."""

    @abstractmethod
    def add(self, sums: dict[str, Tensor], ids: Tensor, td: TensorDictBase) -> None:
        """Add a step with its outcome to the sums of the missions ``ids``, in place."""

    @abstractmethod
    def table(
        self, env: EnvBase, missions: TensorDictBase, sums: dict[str, Tensor]
    ) -> dict[str, Any]:
        """Return the columns of the table of missions.

        Among them ``finished``, whether the mission reached its goal, or ``terminated``, whether
        the episode ended early, where there is none.

        Args:
            env: where the missions were.
            missions: what they were.
            sums: all sums, and ``steps``, the number of each mission's last step.
        """
