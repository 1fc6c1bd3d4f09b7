"""Courses: where a robot is to go, as tracks on the ground and as flights."""
