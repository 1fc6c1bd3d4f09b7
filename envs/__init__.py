"""Environments: robots whose dynamics change under way."""

from afm_rl.envs.course import Course
from afm_rl.envs.mission_noise import MissionNoise
from afm_rl.envs.missions import MissionFormat
from afm_rl.envs.rendering import TrackCanvas
from afm_rl.envs.track import Track
from afm_rl.envs.tracks import load_track
from afm_rl.envs.ugv import UGVTrack
from afm_rl.envs.ugv_gym import UGVTrackGym
from afm_rl.envs.ugv_vector import UGVTrackVectorEnv

__all__ = [
    "Course",
    "MissionFormat",
    "MissionNoise",
    "Track",
    "TrackCanvas",
    "UGVTrack",
    "UGVTrackGym",
    "UGVTrackVectorEnv",
    "load_track",
]
