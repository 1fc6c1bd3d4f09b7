"""Environments: robots whose dynamics change under way."""

from afm_rl.envs.actuator_inversion import actuator_inversion_task
from afm_rl.envs.arm import arm_task
from afm_rl.envs.course import Course
from afm_rl.envs.gusty_pendulum import gusty_pendulum_task
from afm_rl.envs.mission_noise import MissionNoise
from afm_rl.envs.missions import MissionFormat
from afm_rl.envs.quadrotor import CrazyflieTrack
from afm_rl.envs.quadrotor_gym import CrazyflieTrackGym
from afm_rl.envs.quadrotor_rotorpy import RotorPyTrack, rotorpy_crazyflie
from afm_rl.envs.references import (
    Circle,
    FigureEight,
    Hover,
    Reference,
    Table,
    Waypoints,
    find_reference,
    load_reference,
)
from afm_rl.envs.rendering import TrackCanvas
from afm_rl.envs.settings import schedule_in_seconds
from afm_rl.envs.skid_steer import WheelPhysics, skid_steer
from afm_rl.envs.task import Task
from afm_rl.envs.task_env import TaskEnv
from afm_rl.envs.task_hosts import environment_task
from afm_rl.envs.task_sources import dm_control_task, function_task, gymnasium_task, mujoco_task
from afm_rl.envs.track import Track
from afm_rl.envs.tracks import load_track
from afm_rl.envs.ugv import UGVTrack
from afm_rl.envs.ugv_gym import UGVTrackGym
from afm_rl.envs.ugv_vector import UGVTrackVectorEnv

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
    "actuator_inversion_task",
    "arm_task",
    "dm_control_task",
    "environment_task",
    "find_reference",
    "gusty_pendulum_task",
    "gymnasium_task",
    "load_reference",
    "load_track",
    "mujoco_task",
    "function_task",
    "rotorpy_crazyflie",
    "schedule_in_seconds",
    "skid_steer",
]
