"""TorchRL transforms, and the same correction as a policy and as gymnasium's wrappers."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
