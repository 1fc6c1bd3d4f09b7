"""What the benchmarks share."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

WARM_UP = 3  # rounds that do not count


def timed(
    jobs: Mapping[str, Callable[[], object]],
    rounds: int,
    warm_up: int = WARM_UP,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Run every job once per round, in turns; return milliseconds of a clock in seconds."""
    spent: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(rounds + warm_up):
        for name, job in jobs.items():
            start = clock()
            job()
            if turn >= warm_up:
                spent[name].append(1e3 * (clock() - start))
    return spent
