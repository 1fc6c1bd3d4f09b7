"""A page in the browser to play with: the same policy on two robots, without and with AFM."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
