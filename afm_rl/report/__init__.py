"""Folders of results become one table, :class:`Runs`; tables, figures and films are views of it."""

from afm_rl.deprecated import lazy_package

__getattr__, __dir__, __all__ = lazy_package(__name__, __file__)
