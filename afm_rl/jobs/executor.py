"""Where jobs run, and how far they are."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Any

from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.jobs.layout import LOG
from afm_rl.jobs.process import PROGRESS, Job, is_done, last_words, said, start
from afm_rl.progress import Bar
from afm_rl.storage.manifest import UNFINISHED

FORM = "{elapsed} so far{postfix}"


class Board:
    """Shows how far jobs are, and how much time is left, by those that have ended."""

    def __init__(
        self, jobs: Sequence[Job], count: int, shown: bool, echo: Callable[[str], object]
    ) -> None:
        self.jobs, self.done, self.count, self.echo = set(jobs), count - len(jobs), count, echo
        self.told: set[str] = set()
        self.shares = {job: share_of(job) or 0.0 for job in jobs}
        begun, total = sum(self.shares.values()), len(jobs)
        look: Any = {"desc": "jobs", "shown": shown, "leave": False, "form": FORM}
        self.whole = Bar(initial=begun, total=total, **look)
        self.looked = time.monotonic()
        self.began: dict[Job, float] = {}  # as far as it was seen
        self.took: list[float] = []  # seconds, by those that have ended

    def __enter__(self) -> Board:
        return self

    def __exit__(self, *error: object) -> None:
        self.whole.close()

    def end(self, job: Job, failure: str | None) -> None:
        """Say that a job is over, and why it failed, or what else it said that is new."""
        self.jobs.remove(job)
        self.done += 1
        self.shares[job] = 1.0
        if job in self.began:
            self.took.append(time.monotonic() - self.began.pop(job))
        line = f"[{self.done}/{self.count}] {job}: "
        line += f"failed: {failure}" if failure else "done"
        with suppress(OSError):
            output = [] if failure else (job.folder / LOG).read_text().splitlines()
            line = "\n".join([line, *(f"  {text}" for text in output if text not in self.told)])
            self.told.update(output)
        (Bar.write if self.whole.live and not self.whole.disable else self.echo)(line)

    def look(self) -> None:
        """Look at the jobs that run, if it is time to."""
        now = time.monotonic()
        if self.whole.disable or now - self.looked < self.whole.mininterval:
            return
        self.looked = now
        at_work = {job: share for job in self.jobs if (share := share_of(job)) is not None}
        for job, share in at_work.items():
            self.shares[job] = max(share, self.shares[job])  # one that continues from a checkpoint
            self.began.setdefault(job, now)
        said = f"{self.done}/{self.count} jobs, {len(at_work)} running"
        if self.took and at_work:
            waiting = len(self.jobs) - len(at_work)
            left = time_left(self.took, waiting, len(at_work))
            said += f", about {Bar.format_interval(left)} left"
        self.whole.set_postfix_str(said, refresh=False)
        self.whole.n = sum(self.shares.values())
        self.whole.refresh()


def time_left(took: Sequence[float], waiting: int, at_work: int) -> float:
    """Return how long jobs may take yet (s), if they are like those that have ended.

    Of those at work half is done, on average.

    >>> time_left([50.0, 70.0], waiting=3, at_work=2)
    120.0
    """
    return sum(took) / len(took) * (waiting + at_work / 2) / at_work


def share_of(job: Job) -> float | None:
    """Return the share of a job's work that is done; None if it has not begun."""
    try:
        return float((job.folder / UNFINISHED / PROGRESS).read_text())
    except (OSError, ValueError):
        return None


class JobsFailed(AFMError):
    """Some jobs have no results."""

    status = 1  # of the command


class Executor:
    """Runs some jobs at a time on this machine.

    A job is a process of its own, so that no job can harm another, and its results and failures are
    files in its folder. Jobs end with the command, and write a checkpoint first.

    Args:
        n_jobs: jobs at a time; -1 means one per core, -2 one less, and so on.
        grace: time that a job has for its checkpoint (s).

    Raises:
        ConfigurationError: if ``n_jobs`` is no whole number, or 0.
    """

    tick = 0.05
    """Seconds between two looks at jobs."""

    def __init__(self, n_jobs: int = -1, grace: float = 20.0) -> None:
        if isinstance(n_jobs, bool) or not isinstance(n_jobs, int) or n_jobs == 0:
            raise ConfigurationError(
                f"hydra.launcher.n_jobs={n_jobs!r}: expected a whole number other than 0"
            )
        cores = os.cpu_count() or 1
        self.size = n_jobs if n_jobs > 0 else max(1, cores + 1 + n_jobs)
        self.grace = grace

    def run(self, jobs: Sequence[Job], board: Board) -> dict[str, str]:
        """Run jobs, in any order; return why some have no results, by name."""
        waiting, running, failures = deque(jobs), dict[Job, Any](), dict[str, str]()
        try:
            while waiting or running:
                for _ in range(min(self.size - len(running), len(waiting))):
                    job = waiting.popleft()
                    running[job] = self.start(job)
                for job in [job for job, process in running.items() if not process.is_alive()]:
                    process = running.pop(job)
                    if not is_done(job):
                        failures[job.name] = said(job) or last_words(process.exitcode or 0)
                    board.end(job, failures.get(job.name))
                board.look()
                time.sleep(self.tick if running else 0.0)
        finally:
            self.close(running.values())
        return failures

    def start(self, job: Job) -> Any:
        """Start a job; return its process."""
        return start(job)

    def close(self, processes: Collection[Any]) -> None:
        """End the jobs that still run when the command ends."""
        for process in processes:
            process.terminate()
        latest = time.monotonic() + self.grace
        for process in processes:
            process.join(max(0.0, latest - time.monotonic()))
            process.kill()
            process.join()
