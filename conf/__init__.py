"""Hydra configuration groups, importable as ``pkg://afm_rl.conf``."""
