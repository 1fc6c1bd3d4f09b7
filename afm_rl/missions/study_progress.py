"""How far a study is: a line per method in a terminal, a line per shard elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from afm_rl.missions.shard import Shard
from afm_rl.missions.study_worker import Report


@dataclass
class Method:
    """What is known of a method's missions."""

    total: int
    """Missions of all its shards."""
    done: int = 0
    """Missions of shards with results."""
    started: float | None = None
    """When its first shard was taken up, this time."""
    before: float = 0.0
    """Share of the work that was done by then."""
    reports: dict[Shard, Report] = field(default_factory=dict)
    """The last report of each of its shards that is not over."""

    @property
    def missions(self) -> int:
        """Missions that have ended."""
        return self.done + sum(report.finished for report in self.reports.values())

    def share(self, cells: int) -> float:
        """Return the share of the work done, at least; ``cells`` missions make a shard."""
        running = sum(report.share for report in self.reports.values())
        return (self.done + cells * running) / self.total

    @property
    def rate(self) -> float:
        """Steps per second, of all its missions that run together."""
        reports = [report for report in self.reports.values() if report.seconds > 0]
        return sum(report.rows / report.seconds for report in reports)


class Board:
    """Shows the progress of a study.

    Args:
        shards: all shards asked for.
        finished: those that have results already.
        cells: missions per shard.
        live: one line per method that changes, if standard error is a terminal.
        echo: receives a line for each shard that is over, otherwise.
    """

    def __init__(
        self,
        shards: Sequence[Shard],
        finished: Sequence[Shard],
        cells: int,
        live: bool,
        echo: Callable[[str], object],
    ) -> None:
        self.cells = cells
        self.count = len(shards)
        self.over = len(finished)
        self.echo = echo
        self.methods = {shard.method: Method(0) for shard in shards}
        for shard in shards:
            self.methods[shard.method].total += cells
        for shard in finished:
            self.methods[shard.method].done += cells
        for method in self.methods.values():
            method.before = method.share(cells)
        console = Console(stderr=True)
        self.live = live and console.is_terminal
        self.progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[line]}"),
            console=console,
            disable=not self.live,
            auto_refresh=False,
        )
        self.tasks: dict[str, TaskID] = {
            name: self.progress.add_task(name, total=method.total, line="")
            for name, method in self.methods.items()
        }
        for name in self.methods:
            self._show(name)

    def __enter__(self) -> Board:
        self.progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.progress.stop()

    def hear(self, shard: Shard, report: Report, told: str) -> None:
        """Take in a report; ``told`` is what to say of a shard that is over."""
        method = self.methods[shard.method]
        if method.started is None:
            method.started = time.monotonic()
        if report.over:
            method.reports.pop(shard, None)
            method.done += 0 if report.failure else self.cells
            self.over += 1
            if not self.live:
                self.echo(f"[{self.over}/{self.count}] {told}")
            elif report.failure:
                self.progress.console.print(told, highlight=False, markup=False)
        else:
            method.reports[shard] = report
        self._show(shard.method)
        self.progress.refresh()

    def _show(self, name: str) -> None:
        method = self.methods[name]
        share = method.share(self.cells)
        line = line_of(method, share, time.monotonic())
        self.progress.update(self.tasks[name], completed=share * method.total, line=line)


def line_of(method: Method, share: float, now: float) -> str:
    """Return missions, rate, and time spent and left of a method.

    >>> line_of(Method(total=110, done=22, started=0.0), 0.2, now=90.0)
    '22/110 missions, 1:30 so far, 6:00 left'
    """
    parts = [f"{method.missions}/{method.total} missions"]
    if method.rate:
        parts.append(f"{method.rate:.0f} steps/s")
    if method.started is not None and method.missions < method.total:
        spent = now - method.started
        parts.append(f"{clock(spent)} so far")
        if share > method.before:
            parts.append(f"{clock(spent * (1 - share) / (share - method.before))} left")
    return ", ".join(parts)


def clock(seconds: float) -> str:
    """Return hours, minutes and seconds.

    >>> clock(75), clock(3661)
    ('1:15', '1:01:01')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
