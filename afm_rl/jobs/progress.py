"""Progress of a batch: live lines in a terminal, a line every ten seconds elsewhere."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from afm_rl.jobs.layout import LOG, UNFINISHED
from afm_rl.jobs.process import PROGRESS, Job

EVERY = 10.0  # seconds between two lines, off a terminal
OFTEN = 0.5  # seconds between two looks at the jobs, in a terminal


class Board:
    """Shows how far jobs are, and how much time is left.

    Args:
        jobs: those that are still to be run.
        count: of all jobs, also the finished ones.
        shown: show progress; the ends of jobs are said in any case.
        echo: receives lines of text, off a terminal.
    """

    def __init__(
        self, jobs: Sequence[Job], count: int, shown: bool, echo: Callable[[str], object]
    ) -> None:
        self.jobs = list(jobs)
        self.count = count
        self.shown = shown
        self.echo = echo
        self.ended: set[Job] = set()
        self.told: set[str] = set()
        self.shares = {job: state[1] for job in jobs if (state := self._state(job))}
        self.before = sum(self.shares.values())
        self.start = self.said = time.monotonic()
        console = Console(stderr=True)
        self.live = shown and console.is_terminal
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[line]}"))
        self.progress = Progress(
            *columns, console=console, disable=not self.live, auto_refresh=False, transient=True
        )
        self.whole = self.progress.add_task("", total=1.0, line="")
        self.tasks: dict[Job, TaskID] = {}

    def __enter__(self) -> Board:
        self.progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.progress.stop()

    def end(self, job: Job, failure: str | None) -> None:
        """Say that a job is over, and why it failed, or what else it said that is new."""
        self.ended.add(job)
        self.shares[job] = 1.0
        if job in self.tasks:
            self.progress.remove_task(self.tasks.pop(job))
        over = self.count - len(self.jobs) + len(self.ended)
        line = f"[{over}/{self.count}] {job}: " + (f"failed: {failure}" if failure else "done")
        with suppress(OSError):
            told = [] if failure else (job.folder / LOG).read_text().splitlines()
            line = "\n".join([line, *(f"  {text}" for text in told if text not in self.told)])
            self.told.update(told)
        if self.live:
            self.progress.console.print(line, highlight=False, markup=False)
        else:
            self.echo(line)

    def look(self) -> None:
        """Look at the jobs that run, if it is time to."""
        now = time.monotonic()
        if not self.shown or now - self.said < (OFTEN if self.live else EVERY):
            return
        self.said = now
        running = {job: state for job in self.jobs if (state := self._state(job))}
        self.shares.update({job: share for job, (_, share) in running.items()})
        share, before = (each / len(self.jobs) for each in (sum(self.shares.values()), self.before))
        over = self.count - len(self.jobs) + len(self.ended)
        line = f"{over}/{self.count} jobs, {len(running)} at work, " + time_left(
            now - self.start, share, before
        )
        if not self.live:
            self.echo(line)
            return
        self.progress.update(self.whole, completed=share, line=line)
        for job, (text, own) in running.items():
            if job not in self.tasks:
                self.tasks[job] = self.progress.add_task(f"  {job}", total=1.0, line="")
            self.progress.update(self.tasks[job], completed=own, line=text)
        self.progress.refresh()

    def _state(self, job: Job) -> tuple[str, float] | None:
        """Return what a job that runs says of itself."""
        try:
            told = json.loads((job.folder / UNFINISHED / PROGRESS).read_text())
        except (OSError, ValueError):
            return None
        return None if job in self.ended else (str(told["line"]), float(told["share"]))


def time_left(spent: float, share: float, before: float = 0.0) -> str:
    """Say how much of the work is done, and when it will end at this pace.

    Args:
        spent: time so far (s).
        share: of the work that is done.
        before: share that was done at the start.

    >>> time_left(90.0, 0.2)
    '20 %, 1:30 so far, 6:00 left'
    """
    text = f"{100 * share:.0f} %, {clock(spent)} so far"
    if share > before:
        text += f", {clock(spent * (1 - share) / (share - before))} left"
    return text


def clock(seconds: float) -> str:
    """Return hours, minutes and seconds.

    >>> clock(75), clock(3661)
    ('1:15', '1:01:01')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
