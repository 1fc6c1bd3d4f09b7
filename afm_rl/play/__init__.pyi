from .robots import ROBOTS as ROBOTS, PlayedRobot as PlayedRobot, make_robot as make_robot
from .world import Side as Side, World as World
