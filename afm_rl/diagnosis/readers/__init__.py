"""Logs from files.

A reader knows one format and gives a :class:`~afm_rl.diagnosis.readers.source.Source`: the names of
what was logged, and a function that reads some of it. What is a command and what a response is
chosen afterwards, the same way for all formats.
"""

from afm_rl.diagnosis.readers.read import (
    PAIRS,
    TRANSITIONS,
    bounded_memory,
    read_columns,
    read_log,
)
from afm_rl.diagnosis.readers.source import Columns, Unchosen

__all__ = [
    "PAIRS",
    "TRANSITIONS",
    "Columns",
    "Unchosen",
    "bounded_memory",
    "read_columns",
    "read_log",
]
