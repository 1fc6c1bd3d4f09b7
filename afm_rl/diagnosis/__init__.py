"""What the actuators of a robot do, from what it logged."""

from afm_rl.diagnosis.findings import Actuator, Change, Diagnosis
from afm_rl.diagnosis.live import explain
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.settings import Settings
from afm_rl.diagnosis.verdict import diagnose

__all__ = ["Actuator", "Change", "Diagnosis", "Log", "Settings", "diagnose", "explain"]
