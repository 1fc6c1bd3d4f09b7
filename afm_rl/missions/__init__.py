"""Missions: compose an agent from a configuration and run it."""

from afm_rl.missions.build import Agent, build, prepare
from afm_rl.missions.robot import Collection, Robot
from afm_rl.missions.run import Results, run
from afm_rl.missions.scores import LapScore, ReturnScore, Score, TrackingScore
from afm_rl.missions.task_robot import TaskRobot

__all__ = [
    "Agent",
    "Collection",
    "LapScore",
    "Results",
    "ReturnScore",
    "Robot",
    "Score",
    "TaskRobot",
    "TrackingScore",
    "build",
    "prepare",
    "run",
]
