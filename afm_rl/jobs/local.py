"""Jobs on this machine."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Sequence
from multiprocessing.connection import wait

from afm_rl.errors import ConfigurationError
from afm_rl.jobs.process import Ends, Job, Process, reason, start

GRACE = 20.0  # seconds in which a job that is told to stop may write its checkpoint
TICK = 0.25  # seconds between two signs of life


class LocalPool:
    """Runs some jobs at a time, each in a process of its own.

    Args:
        n_jobs: jobs at a time; -1 means one per core, -2 one less, and so on.

    Raises:
        ConfigurationError: if ``n_jobs`` is no whole number, or 0.
    """

    def __init__(self, n_jobs: int = -1) -> None:
        if isinstance(n_jobs, bool) or not isinstance(n_jobs, int) or n_jobs == 0:
            raise ConfigurationError(
                f"hydra.launcher.n_jobs={n_jobs!r}: expected a whole number other than 0"
            )
        cores = os.cpu_count() or 1
        self.size = n_jobs if n_jobs > 0 else max(1, cores + 1 + n_jobs)

    def run(self, jobs: Sequence[Job]) -> Ends:
        """Run jobs, as :class:`~afm_rl.jobs.batch.Pool` says."""
        waiting, running = deque(jobs), dict[Job, Process]()
        try:
            while waiting or running:
                while waiting and len(running) < self.size:
                    job = waiting.popleft()
                    running[job] = start(job)
                wait([process.sentinel for process in running.values()], TICK)
                for job, process in [*running.items()]:
                    if not process.is_alive():
                        del running[job]
                        yield job, reason(job, process)
                yield None
        finally:
            _end(running.values())


def _end(processes) -> None:
    """End processes; they write their checkpoints first."""
    for process in processes:
        process.terminate()
    latest = time.monotonic() + GRACE
    for process in processes:
        process.join(max(0.0, latest - time.monotonic()))
        process.kill()
        process.join()
