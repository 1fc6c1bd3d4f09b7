"""A page in the browser to play with: the same policy on two robots, alone and with AFM."""

from afm_rl.deprecated import lazy_package

__getattr__, __dir__, __all__ = lazy_package(__name__, __file__)
