"""Missions: compose an agent from a configuration and run it."""

from afm_rl.missions.build import Agent, build
from afm_rl.missions.prepare import prepare
from afm_rl.missions.robot import Robot
from afm_rl.missions.run import Results, run

__all__ = ["Agent", "Results", "Robot", "build", "prepare", "run"]
