"""Logs from files.

A reader knows one format and gives a :class:`~afm_rl.diagnosis.readers.source.Source`: the names of
what was logged, and a function that reads some of it. What is a command and what a response is
chosen afterwards, the same way for all formats.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
