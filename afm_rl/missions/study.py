"""Studies: methods x tracks x regimes x seeds, in a folder that can be returned to."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig, OmegaConf

from afm_rl.errors import check_count, check_number
from afm_rl.measures import Measures
from afm_rl.missions.build import Agent, build
from afm_rl.missions.lock import locked
from afm_rl.missions.prepare import prepare
from afm_rl.missions.shard import Shard, tidy
from afm_rl.missions.study_crew import Crew
from afm_rl.missions.study_progress import Board
from afm_rl.missions.study_record import asked, record
from afm_rl.missions.study_tables import write_tables
from afm_rl.missions.study_worker import Report

MOST_WORKERS = 4  # unless more are asked for


@dataclass
class Outcome:
    """What a study came to."""

    missions: pd.DataFrame
    """All missions so far, one per row, with their times."""
    failures: dict[Shard, str]
    """Why shards have no results."""
    measures: Measures
    """What the missions are compared by."""


def run_study(
    folder: Path,
    methods: Sequence[DictConfig],
    workers: int | None = None,
    every: float = 60.0,
    progress: bool = False,
    echo: Callable[[str], None] = print,
) -> Outcome:
    """Run a study, or what is left of it.

    The work is done in shards, one method with one seed each, by processes that take the next
    one. Everything that is killed goes on where it was when the study is run again, and the
    results are the same to the bit. Files in the folder:

    * ``study.yaml``: what was asked; ``config/<method>.yaml``: the same per method.
    * ``shards/<method>/<seed>/``: ``missions.csv`` and ``steps.parquet``, or until then
      ``checkpoint.safetensors``, and ``error.txt`` if it failed.
    * ``missions.csv``: all missions so far; ``compute.csv``: what they took.

    Args:
        folder: the study's own; a study with the same settings is taken up and extended.
        methods: one configuration per method, each with its label, alike otherwise.
        workers: processes; None for one per core, but no more than four.
        every: time between two checkpoints (s).
        progress: show progress in a terminal.
        echo: receives lines of text.

    Raises:
        ConfigurationError: for settings that cannot be used or are not those of the folder,
            and if another process is at work there.
        ArtefactError: if a trained part in the cache, or the study's record, is damaged.
    """
    cores = min(os.cpu_count() or 1, MOST_WORKERS)
    size = cores if workers is None else check_count("study.workers", workers)
    check_number("study.every", every, low=0.0)
    agents = {cfg.label: build(cfg) for cfg in methods}
    now = asked(methods).shards
    with locked(folder):
        whole = record(folder, methods).shards
        finished = [shard for shard in now if shard.finished(folder)]
        for shard in whole:
            if shard.finished(folder):
                tidy(shard.folder(folder))
        waiting = [shard for shard in now if shard not in finished]
        if finished:
            echo(f"{len(finished)} of {len(now)} shards have results already")
        _train(methods, agents, {shard.method for shard in waiting}, progress, echo)
        cells = len(next(iter(agents.values())).missions) // len({shard.seed for shard in now})
        failures: dict[Shard, str] = {}

        def listen(shard: Shard, report: Report) -> None:
            told = f"{shard}: "
            if report.failure:
                failures[shard] = report.failure
                told += f"failed: {report.failure}"
            elif report.over:
                missions = write_tables(folder, whole)
                told += _effort(missions, shard)
            board.hear(shard, report, told)

        texts = {cfg.label: OmegaConf.to_yaml(cfg, resolve=True) for cfg in methods}
        with Board(now, finished, cells, progress, echo) as board:
            Crew(folder, texts, size, every, listen).work(waiting)
        measures = next(iter(agents.values())).robot.metrics.measures
        return Outcome(write_tables(folder, whole), failures, measures)


def _train(
    methods: Sequence[DictConfig],
    agents: dict[str, Agent],
    needed: set[str],
    progress: bool,
    echo: Callable[[str], None],
) -> None:
    """Fill the cache here, so that no two workers train the same part."""
    for cfg in methods:
        if cfg.label in needed and agents[cfg.label].trainings:
            echo(f"{cfg.label}:")
            prepare(agents[cfg.label], cfg.cache, progress, lambda line: echo(f"  {line}"))


def _effort(missions: pd.DataFrame, shard: Shard) -> str:
    """Say what a shard took."""
    rows = missions[(missions["method"] == shard.method) & (missions["seed"] == shard.seed)]
    steps = int((rows["steps"] + 1).sum())
    return f"{len(rows)} missions, {steps} steps in {rows['seconds'].sum():.1f} s"
