"""The Actuator Inversion Benchmark."""

from actuator_inversion.task import actuator_inversion_task

__all__ = ["actuator_inversion_task"]
