"""Spaces: where states and actions live, and the mathematics done on them."""
