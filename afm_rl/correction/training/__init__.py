"""How the flow is trained: on regimes without a robot, and refined on one."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
