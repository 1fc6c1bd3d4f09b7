"""How flows are trained: the universal one without a robot, the published one on a model."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
