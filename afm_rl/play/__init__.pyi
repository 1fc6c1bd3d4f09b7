from .robots import ROBOTS as ROBOTS, Robot as Robot, make_robot as make_robot
from .world import FaultyEnv as FaultyEnv, Side as Side, World as World
