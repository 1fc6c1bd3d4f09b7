"""What the actuators of a robot do, from what it logged."""

import lazy_loader

from afm_rl.imports import check_installed

check_installed("diagnosis", "scipy")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
