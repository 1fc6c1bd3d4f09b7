"""Long logs are read in blocks of rows."""

from __future__ import annotations

import numpy as np


def blocks_of(rows: int, most: int = 400_000, count: int = 8) -> list[tuple[int, int]]:
    """Return first and last row (exclusive) of what is read of a log.

    All rows, or blocks that are evenly spread: a block is long enough for every delay, and changes
    on the way are seen. 400,000 rows of twenty numbers take 64 MB.

    >>> blocks_of(100), blocks_of(1000, most=100, count=2)
    ([(0, 100)], [(0, 50), (950, 1000)])
    """
    if rows <= most:
        return [(0, rows)]
    length = most // count
    return [(int(a), int(a) + length) for a in np.linspace(0, rows - length, count)]


def thinned_note(rows: int, blocks: list[tuple[int, int]]) -> tuple[str, ...]:
    """Return what must be said where rows were left out.

    >>> thinned_note(1000, [(0, 50), (950, 1000)])
    ('1,000 rows are many: 2 blocks of 50 were read',)
    """
    if len(blocks) == 1:
        return ()
    length = blocks[0][1] - blocks[0][0]
    return (f"{rows:,} rows are many: {len(blocks)} blocks of {length:,} were read",)
