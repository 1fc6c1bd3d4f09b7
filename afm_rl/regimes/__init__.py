"""Regimes: what changes under the robot, and when."""

from afm_rl.regimes.actuators import actuator_regimes
from afm_rl.regimes.asymmetric import AsymmetricGain
from afm_rl.regimes.backlash import Backlash
from afm_rl.regimes.base import DelayedRegime, Regime, StaticRegime
from afm_rl.regimes.bias import Bias
from afm_rl.regimes.compose import Compose
from afm_rl.regimes.dead import DeadActuator
from afm_rl.regimes.dead_zone import DeadZone
from afm_rl.regimes.delay import Delay
from afm_rl.regimes.flight import (
    InertiaFactor,
    MassFactor,
    MotorEfficiency,
    Payload,
    Wind,
    flight_regimes,
    wind_of,
)
from afm_rl.regimes.gain import ActionGain
from afm_rl.regimes.gain_noise import GainNoise
from afm_rl.regimes.lag import Lag
from afm_rl.regimes.patches import Patches
from afm_rl.regimes.permutation import Permutation
from afm_rl.regimes.physics import Physics
from afm_rl.regimes.quantisation import Quantisation
from afm_rl.regimes.rotation import Rotation
from afm_rl.regimes.saturation import Saturation
from afm_rl.regimes.schedule import Schedule, blend_phases, phase_parameters
from afm_rl.regimes.slip import WheelSlip

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
