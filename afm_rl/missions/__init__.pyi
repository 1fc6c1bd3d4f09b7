from .build import Agent as Agent, build as build, prepare as prepare
from .robot import Collection as Collection, Robot as Robot
from .run import Results as Results, run as run
from .scores import (
    LapScore as LapScore,
    ReturnScore as ReturnScore,
    Score as Score,
    TrackingScore as TrackingScore,
)
from .task_robot import TaskRobot as TaskRobot
