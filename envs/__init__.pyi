from .courses.flights import (
    Circle as Circle,
    FigureEight as FigureEight,
    Hover as Hover,
    Reference as Reference,
    SampledReference as SampledReference,
    find_reference as find_reference,
    load_reference as load_reference,
)
from .courses.rendering import TrackCanvas as TrackCanvas
from .courses.track import Course as Course, Track as Track
from .courses.tracks import load_track as load_track
from .missions.format import MissionFormat as MissionFormat, MissionNoise as MissionNoise
from .missions.settings import schedule_in_seconds as schedule_in_seconds
from .quadrotor.env import CrazyflieTrack as CrazyflieTrack, CrazyflieTrackGym as CrazyflieTrackGym
from .quadrotor.rotorpy import RotorPyTrack as RotorPyTrack, rotorpy_crazyflie as rotorpy_crazyflie
from .task.arm import arm_task as arm_task
from .task.env import TaskEnv as TaskEnv
from .task.hosts import environment_task as environment_task
from .task.own import function_task as function_task, mujoco_task as mujoco_task
from .task.published import dm_control_task as dm_control_task, gymnasium_task as gymnasium_task
from .task.task import Task as Task
from .ugv.env import UGVTrack as UGVTrack
from .ugv.gym import UGVTrackGym as UGVTrackGym
from .ugv.skid_steer import WheelPhysics as WheelPhysics, skid_steer as skid_steer
