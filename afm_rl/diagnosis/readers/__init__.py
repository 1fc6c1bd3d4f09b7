"""Logs from files.

A reader knows one format and gives a :class:`~afm_rl.diagnosis.readers.source.Source`: the names of
what was logged, and a function that reads some of it. What is a command and what a response is
chosen afterwards, the same way for all formats.
"""

from afm_rl.deprecated import lazy_package

__getattr__, __dir__, __all__ = lazy_package(__name__, __file__)
