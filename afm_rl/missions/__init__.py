"""Missions: compose an agent from a configuration and run it."""

from afm_rl.missions.build import Agent, build
from afm_rl.missions.collection import Collection
from afm_rl.missions.laps import LapScore
from afm_rl.missions.prepare import prepare
from afm_rl.missions.return_score import ReturnScore
from afm_rl.missions.robot import Robot
from afm_rl.missions.run import Results, run
from afm_rl.missions.score import Score
from afm_rl.missions.task_robot import TaskRobot
from afm_rl.missions.tracking_score import TrackingScore

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
