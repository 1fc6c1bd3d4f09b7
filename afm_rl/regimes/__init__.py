"""Regimes: what changes under the robot, and when."""

from afm_rl.regimes.base import Compose, Regime
from afm_rl.regimes.gain import ActionGain
from afm_rl.regimes.schedule import Schedule, phase_parameters

__all__ = ["ActionGain", "Compose", "Regime", "Schedule", "phase_parameters"]
