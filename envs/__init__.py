"""Environments: robots whose dynamics change under way."""

from afm_rl.envs.courses.flights import (
    Circle,
    FigureEight,
    Hover,
    Reference,
    Table,
    Waypoints,
    find_reference,
    load_reference,
)
from afm_rl.envs.courses.rendering import TrackCanvas
from afm_rl.envs.courses.track import Course, Track
from afm_rl.envs.courses.tracks import load_track
from afm_rl.envs.missions.format import MissionFormat, MissionNoise
from afm_rl.envs.missions.settings import schedule_in_seconds
from afm_rl.envs.quadrotor.env import CrazyflieTrack, CrazyflieTrackGym
from afm_rl.envs.quadrotor.rotorpy import RotorPyTrack, rotorpy_crazyflie
from afm_rl.envs.task.arm import arm_task
from afm_rl.envs.task.env import TaskEnv
from afm_rl.envs.task.hosts import environment_task
from afm_rl.envs.task.own import function_task, mujoco_task
from afm_rl.envs.task.published import dm_control_task, gymnasium_task
from afm_rl.envs.task.task import Task
from afm_rl.envs.ugv.env import UGVTrack
from afm_rl.envs.ugv.gym import UGVTrackGym, UGVTrackVectorEnv
from afm_rl.envs.ugv.skid_steer import WheelPhysics, skid_steer

__all__ = [
    "Circle",
    "Course",
    "CrazyflieTrack",
    "CrazyflieTrackGym",
    "FigureEight",
    "Hover",
    "MissionFormat",
    "MissionNoise",
    "Reference",
    "RotorPyTrack",
    "Table",
    "Task",
    "TaskEnv",
    "Track",
    "TrackCanvas",
    "UGVTrack",
    "UGVTrackGym",
    "UGVTrackVectorEnv",
    "Waypoints",
    "WheelPhysics",
    "arm_task",
    "dm_control_task",
    "environment_task",
    "find_reference",
    "gymnasium_task",
    "load_reference",
    "load_track",
    "mujoco_task",
    "function_task",
    "rotorpy_crazyflie",
    "schedule_in_seconds",
    "skid_steer",
]
