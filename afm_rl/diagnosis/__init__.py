"""What the actuators of a robot do, from what it logged."""

from afm_rl.diagnosis.findings import Actuator, Change, Diagnosis
from afm_rl.diagnosis.live import explain

__all__ = ["Actuator", "Change", "Diagnosis", "explain"]
