"""Environments of this project."""

from envs.ferry import Ferry, drift

__all__ = ["Ferry", "drift"]
