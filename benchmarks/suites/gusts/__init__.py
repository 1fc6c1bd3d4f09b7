"""OMAC's pendulum in gusts of wind."""

from gusts.pendulum import Gusts, gusty_pendulum_task, steer

__all__ = ["Gusts", "gusty_pendulum_task", "steer"]
