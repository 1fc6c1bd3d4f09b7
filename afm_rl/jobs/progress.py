"""Progress of a batch: a line per job in a terminal, one for all every ten seconds elsewhere."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from afm_rl.jobs.layout import LOG
from afm_rl.jobs.process import PROGRESS, Job
from afm_rl.progress import Bar
from afm_rl.storage.manifest import UNFINISHED


class Board:
    """Shows how far jobs are, and how much time is left."""

    def __init__(
        self, jobs: Sequence[Job], count: int, shown: bool, echo: Callable[[str], object]
    ) -> None:
        self.jobs, self.done, self.count, self.echo = set(jobs), count - len(jobs), count, echo
        self.told: set[str] = set()
        self.bars: dict[Job, Bar] = {}
        self.shares = {job: self._state(job)[1] for job in jobs}
        begun, total = sum(self.shares.values()), len(jobs)
        self.whole = Bar(desc="jobs", shown=shown, leave=False, initial=begun, total=total)
        self.looked = time.monotonic()

    def __enter__(self) -> Board:
        return self

    def __exit__(self, *error: object) -> None:
        for bar in (*self.bars.values(), self.whole):
            bar.close()

    def end(self, job: Job, failure: str | None) -> None:
        """Say that a job is over, and why it failed, or what else it said that is new."""
        self.jobs.remove(job)
        self.done += 1
        self.shares[job] = 1.0
        if job in self.bars:
            self.bars.pop(job).close()
        line = f"[{self.done}/{self.count}] {job}: "
        line += f"failed: {failure}" if failure else "done"
        with suppress(OSError):
            told = [] if failure else (job.folder / LOG).read_text().splitlines()
            line = "\n".join([line, *(f"  {text}" for text in told if text not in self.told)])
            self.told.update(told)
        (Bar.write if self.whole.live and not self.whole.disable else self.echo)(line)

    def look(self) -> None:
        """Look at the jobs that run, if it is time to."""
        now = time.monotonic()
        if self.whole.disable or now - self.looked < self.whole.mininterval:
            return
        self.looked = now
        states = {job: state for job in self.jobs if (state := self._state(job))[0]}
        for job, (line, share) in states.items():
            self.shares[job] = max(share, self.shares[job])  # one that goes on from a checkpoint
            if self.whole.live:
                bar = self.bars.get(job) or Bar(desc=f"  {job}", total=1.0, leave=False)
                self.bars[job] = bar
                bar.set_postfix_str(line, refresh=False)
                bar.n = share
                bar.refresh()
        said = f"{self.done}/{self.count} jobs, {len(states)} at work"
        self.whole.set_postfix_str(said, refresh=False)
        self.whole.n = sum(self.shares.values())
        self.whole.refresh()

    def _state(self, job: Job) -> tuple[str, float]:
        """Return what a job that runs says of itself; "" if it has not begun."""
        try:
            told = json.loads((job.folder / UNFINISHED / PROGRESS).read_text())
            return str(told["line"]), float(told["share"])
        except (OSError, ValueError):
            return "", 0.0
