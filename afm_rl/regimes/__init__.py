"""Regimes: what changes under the robot, and when."""

from afm_rl.regimes.base import DelayedRegime, Regime, StaticRegime
from afm_rl.regimes.commands import DeadZone, Permutation, Quantisation, Rotation, Saturation
from afm_rl.regimes.compose import Compose, actuator_regimes
from afm_rl.regimes.flight import (
    InertiaFactor,
    MassFactor,
    MotorEfficiency,
    Payload,
    Wind,
    flight_regimes,
    wind_of,
)
from afm_rl.regimes.gains import ActionGain, AsymmetricGain, Bias, DeadActuator, GainNoise
from afm_rl.regimes.ground import Patches, WheelSlip
from afm_rl.regimes.late import Backlash, Delay, Lag
from afm_rl.regimes.physics import Physics
from afm_rl.regimes.schedule import Schedule, blend_phases, phase_parameters

__all__ = [
    "ActionGain",
    "AsymmetricGain",
    "Backlash",
    "Bias",
    "Compose",
    "DeadActuator",
    "DeadZone",
    "Delay",
    "DelayedRegime",
    "GainNoise",
    "InertiaFactor",
    "Lag",
    "MassFactor",
    "MotorEfficiency",
    "Patches",
    "Payload",
    "Permutation",
    "Physics",
    "Quantisation",
    "Regime",
    "Rotation",
    "Saturation",
    "Schedule",
    "StaticRegime",
    "WheelSlip",
    "Wind",
    "actuator_regimes",
    "blend_phases",
    "flight_regimes",
    "phase_parameters",
    "wind_of",
]
