"""Where jobs run: one interface, and this machine as the first of its kind."""

from __future__ import annotations

import os
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Collection, Sequence
from typing import Any

from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.jobs.process import Job, is_done, last_words, said, start
from afm_rl.jobs.progress import Board


class JobsFailed(AFMError):
    """Some jobs have no results."""


class Executor(ABC):
    """Runs jobs. A subclass starts some, and says when one is over.

    Whatever the executor, a job is a process of its own, so that no job can harm another, and its
    results and failures are files in its folder: a batch may be begun with one executor and
    finished with another.
    """

    size = sys.maxsize
    """Jobs at a time."""
    tick = 0.5
    """Seconds between two looks at jobs."""

    @abstractmethod
    def start(self, jobs: Sequence[Job]) -> Sequence[Any]:
        """Start jobs; return a handle of each."""

    @abstractmethod
    def is_over(self, handle: Any) -> bool:
        """Return whether a job has ended, in whatever way."""

    def last_words(self, handle: Any) -> str:
        """Say how a job ended that left neither results nor a reason."""
        return "it ended before its results were whole"

    @abstractmethod
    def close(self, handles: Collection[Any]) -> None:
        """Deal with the jobs that still run when the command ends, if any."""

    def run(self, jobs: Sequence[Job], board: Board) -> dict[str, str]:
        """Run jobs, in any order; return why some have no results, by name.

        Args:
            jobs: what to run.
            board: is told of each job that is over, and looks at the others now and then.
        """
        waiting, running, failures = deque(jobs), dict[Job, Any](), dict[str, str]()
        try:
            while waiting or running:
                room = min(self.size - len(running), len(waiting))
                chosen = [waiting.popleft() for _ in range(room)]
                running.update(zip(chosen, self.start(chosen) if chosen else (), strict=True))
                for job in [job for job, handle in running.items() if self.is_over(handle)]:
                    handle = running.pop(job)
                    if not is_done(job):
                        failures[job.name] = said(job) or self.last_words(handle)
                    board.end(job, failures.get(job.name))
                board.look()
                time.sleep(self.tick if running else 0.0)
        finally:
            self.close(running.values())
        return failures


class LocalExecutor(Executor):
    """Runs some jobs at a time on this machine.

    They end with the command, and write a checkpoint first.

    Args:
        n_jobs: jobs at a time; -1 means one per core, -2 one less, and so on.
        grace: time that a job has for its checkpoint (s).

    Raises:
        ConfigurationError: if ``n_jobs`` is no whole number, or 0.
    """

    tick = 0.05

    def __init__(self, n_jobs: int = -1, grace: float = 20.0) -> None:
        if isinstance(n_jobs, bool) or not isinstance(n_jobs, int) or n_jobs == 0:
            raise ConfigurationError(
                f"hydra.launcher.n_jobs={n_jobs!r}: expected a whole number other than 0"
            )
        cores = os.cpu_count() or 1
        self.size = n_jobs if n_jobs > 0 else max(1, cores + 1 + n_jobs)
        self.grace = grace

    def start(self, jobs: Sequence[Job]) -> Sequence[Any]:
        return [start(job) for job in jobs]

    def is_over(self, handle: Any) -> bool:
        return not handle.is_alive()

    def last_words(self, handle: Any) -> str:
        return last_words(handle.exitcode or 0)

    def close(self, handles: Collection[Any]) -> None:
        for process in handles:
            process.terminate()
        latest = time.monotonic() + self.grace
        for process in handles:
            process.join(max(0.0, latest - time.monotonic()))
            process.kill()
            process.join()
