"""Missions: what one is made of, and what environments of missions share."""
