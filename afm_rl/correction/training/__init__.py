"""How flows are trained: the universal one without a robot, the published one on a model."""

from afm_rl.deprecated import lazy_package

__getattr__, __dir__, __all__ = lazy_package(__name__, __file__)
