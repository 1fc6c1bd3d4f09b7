"""A page in the browser to play with: the same policy on two robots, alone and with AFM."""

from afm_rl.play.robots import ROBOTS, Robot, make_robot
from afm_rl.play.world import Actuators, Side, World

__all__ = ["ROBOTS", "Actuators", "Robot", "Side", "World", "make_robot"]
