"""Processes that share the shards of a study among themselves."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path

from afm_rl.missions.shard import Shard
from afm_rl.missions.study_worker import Report, work

GRACE = 20.0  # seconds in which a worker that is told to stop may write its checkpoint
Listener = Callable[[Shard, Report], None]


@dataclass
class Member:
    """A process and what it works on."""

    process: SpawnProcess
    pipe: Connection
    shard: Shard


class Crew:
    """Workers in processes of their own, one shard at a time each.

    A shard whose process dies is reported as failed, and the others go on.

    Args:
        study: folder of the study.
        texts: settings of each method, as YAML.
        size: number of processes.
        every: time between two checkpoints (s).
        listen: hears of every report.
    """

    def __init__(
        self, study: Path, texts: Mapping[str, str], size: int, every: float, listen: Listener
    ) -> None:
        self.study = study
        self.texts = texts
        self.size = size
        self.every = every
        self.listen = listen
        self.members: list[Member] = []

    def work(self, shards: Sequence[Shard]) -> None:
        """Have all shards worked on; return when there is nothing left to do."""
        waiting = deque(shards)
        try:
            while waiting or self.members:
                while waiting and len(self.members) < self.size:
                    self.members.append(self._hire(waiting.popleft()))
                for ready in wait([member.pipe for member in self.members]):
                    member = next(m for m in self.members if m.pipe is ready)
                    self._hear(member, waiting)
        finally:
            self._dismiss()

    def _hire(self, shard: Shard) -> Member:
        context = multiprocessing.get_context("spawn")  # a fork would copy torch's threads
        ours, theirs = context.Pipe()
        process = context.Process(
            target=work,
            args=(theirs, os.getpid(), self.study, self.texts, self.every),
            daemon=True,
        )
        process.start()
        theirs.close()  # so that the pipe ends with the process
        ours.send(shard)
        return Member(process, ours, shard)

    def _hear(self, member: Member, waiting: deque[Shard]) -> None:
        try:
            report = member.pipe.recv()
        except (EOFError, OSError):
            self.members.remove(member)
            member.process.join()
            reason = last_words(member.process.exitcode or 0)
            self.listen(member.shard, Report(over=True, failure=reason))
            return
        shard = member.shard
        if report.over:
            if waiting:
                member.shard = waiting.popleft()
                member.pipe.send(member.shard)
            else:
                self.members.remove(member)
                member.pipe.send(None)
                member.process.join(GRACE)
        self.listen(shard, report)

    def _dismiss(self) -> None:
        """End those that are still at work; they write their checkpoints first."""
        for member in self.members:
            member.process.terminate()
        latest = time.monotonic() + GRACE
        for member in self.members:
            member.process.join(max(0.0, latest - time.monotonic()))
            member.process.kill()
            member.process.join()


def last_words(status: int) -> str:
    """Say how a process ended.

    >>> last_words(-9)
    'its process was ended by SIGKILL; was there enough memory?'
    >>> last_words(3)
    'its process ended with status 3'
    >>> last_words(0)
    'its process was told to stop'
    """
    if status == 0:
        return "its process was told to stop"
    if status > 0:
        return f"its process ended with status {status}"
    hint = "; was there enough memory?" if status == -signal.SIGKILL else ""
    return f"its process was ended by {signal.Signals(-status).name}{hint}"
