"""Somebody else's task as missions: gymnasium, dm_control, MJCF, a step function."""
