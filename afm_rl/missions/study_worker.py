"""A process that works on one shard of a study after the other."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf

from afm_rl.missions.checkpoint import Stopped
from afm_rl.missions.shard import Shard, run_shard
from afm_rl.missions.state import Loop

REPORT = 0.5  # seconds between two reports


class Report(NamedTuple):
    """What a worker says of its shard."""

    finished: int = 0
    """Missions that have ended."""
    share: float = 0.0
    """Share of the work done, at least: missions that run may end before their budget."""
    rows: int = 0
    """Steps of all missions, since the first one, this time."""
    seconds: float = 0.0
    """Time for these steps (s)."""
    over: bool = False
    """Is the shard done with?"""
    failure: str | None = None
    """Why it has no results."""


class Worker:
    """Works on shards until it is told to stop, or left alone.

    Args:
        pipe: shards come in, reports go out.
        parent: process id of who started this; without it the work ends within a step.
        study: folder of the study.
        texts: settings of each method, as YAML.
        every: time between two checkpoints (s).
    """

    def __init__(
        self, pipe: Connection, parent: int, study: Path, texts: Mapping[str, str], every: float
    ) -> None:
        self.pipe = pipe
        self.parent = parent
        self.study = study
        self.texts = texts
        self.every = every
        self.stopped = False

    def stop(self, *args: object) -> None:
        """Stop after the present step."""
        self.stopped = True

    @property
    def alone(self) -> bool:
        """Has the parent died?"""
        return os.getppid() != self.parent

    def work(self) -> None:
        """Take shards from the pipe until there are none."""
        while not self.stopped and not self.alone:
            if not self.pipe.poll(REPORT):
                continue
            shard = self.pipe.recv()
            if shard is None:
                return
            try:
                report = self._report_on(shard)
            except Stopped:
                return
            self.pipe.send(report)

    def _report_on(self, shard: Shard) -> Report:
        cfg = OmegaConf.create(self.texts[shard.method])
        assert isinstance(cfg, DictConfig)
        start, said, first = 0.0, 0.0, 0

        def watch(loop: Loop, total: int) -> bool:
            nonlocal start, said, first
            now, running = time.monotonic(), len(loop.ids)
            if not start:
                start, first = now, len(loop.log)
            if now - said >= REPORT:
                share = 1 - running / total * (1 - loop.step / cfg.budget)
                self.pipe.send(Report(total - running, share, len(loop.log) - first, now - start))
                said = now
            return self.stopped or self.alone

        try:
            run_shard(self.study, shard, cfg, self.every, watch)
        except Stopped:
            raise
        except Exception as error:
            return Report(over=True, failure=f"{type(error).__name__}: {error}")
        return Report(over=True)


def work(
    pipe: Connection, parent: int, study: Path, texts: Mapping[str, str], every: float
) -> None:
    """Be a worker: the main function of a process."""
    torch.set_num_threads(1)
    worker = Worker(pipe, parent, study, texts, every)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent decides
    signal.signal(signal.SIGTERM, worker.stop)
    try:
        worker.work()
    except (BrokenPipeError, EOFError):  # the parent is gone
        return
