"""A legged robot as a task of the suites."""

from __future__ import annotations

from pathlib import Path

from task import HEALTHY

from afm_rl.comparison import robot as robots
from afm_rl.comparison.policy import Acting
from afm_rl.play.legged import Gait, LeggedRobot

OWN = Path(__file__).parent / "robots"


class Robot(LeggedRobot):
    """A robot and its policy, with the attributes of a task of the zoo.

    Args:
        folder: see :class:`~afm_rl.play.legged.LeggedRobot`.
        name: of the robot.
    """

    def __init__(self, folder: Path, name: str) -> None:
        super().__init__(folder, name)
        self.robot = robots.Robot(name, self.make, {"model": "mujoco"}, self.home)
        self.steps = self.about.get("steps", 500)
        self.at = round(HEALTHY * self.steps)

    def begin(self, seeds: list[int]) -> Acting:
        """Return the policies of the robots from their start, at the time of their commands."""
        return Gait(self, len(seeds))
