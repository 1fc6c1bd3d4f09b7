"""One policy on one robot: without a correction and with several, under faults of its actuators."""

import lazy_loader

from afm_rl.imports import RUN, check_installed

check_installed("compare", *RUN)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
