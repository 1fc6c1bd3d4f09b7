"""How the flow is trained: on regimes without a robot, and refined on one."""

from afm_rl.deprecated import lazy_package

__getattr__, __dir__, __all__ = lazy_package(__name__, __file__)
