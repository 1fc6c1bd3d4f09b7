"""Planners, and the environment in which they plan."""

from afm_rl.deprecated import lazy_package

__getattr__, __dir__, __all__ = lazy_package(__name__, __file__)
