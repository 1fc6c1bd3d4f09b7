"""Folders of results become one table, :class:`Runs`; tables, figures and films are views of it."""

import lazy_loader

from afm_rl.imports import RUN, check_installed

check_installed("reports", *RUN)
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
