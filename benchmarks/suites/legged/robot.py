"""A legged robot as a task of the suites."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from task import HEALTHY, Task

from afm_rl.play.legged import Gait, LeggedRobot

OWN = Path(__file__).parent / "robots"


class Robot(LeggedRobot, Task):
    """A robot and its policy, many times side by side.

    Args:
        folder: see :class:`~afm_rl.play.legged.LeggedRobot`.
        name: of the robot.
    """

    def __init__(self, folder: Path, name: str) -> None:
        super().__init__(folder, name)
        self.steps = self.about.get("steps", 500)
        self.at = round(HEALTHY * self.steps)

    def begin(self, count: int) -> None:
        """Have the policy act in so many robots from their start."""
        self.gait = Gait(self, count)

    def act(self, observations: np.ndarray, infos: dict[str, Any] | None = None) -> np.ndarray:
        """Return the commands of all servos ``(N, A)``, at the time at which they will act."""
        return self.gait(observations, infos)
