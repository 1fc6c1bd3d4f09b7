from .read import (
    PAIRS as PAIRS,
    TRANSITIONS as TRANSITIONS,
    read_columns as read_columns,
    read_log as read_log,
)
from .source import Columns as Columns, Unchosen as Unchosen
