from .read import (
    PAIRS as PAIRS,
    TRANSITIONS as TRANSITIONS,
    bounded_memory as bounded_memory,
    read_columns as read_columns,
    read_log as read_log,
)
from .source import Columns as Columns, Unchosen as Unchosen
