"""A ferry, steered by afm-rl."""
