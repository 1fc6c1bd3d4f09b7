"""From a composed configuration to a folder of results: compose, check, build, run, report."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from afm_rl import missions
from afm_rl.cli.methods import jobs_of
from afm_rl.cli.overrides import values_of
from afm_rl.errors import ConfigurationError, check_count, check_flag
from afm_rl.imports import without_collection
from afm_rl.jobs.batch import run_batch
from afm_rl.jobs.executor import Executor, JobsFailed
from afm_rl.jobs.layout import LOG
from afm_rl.jobs.process import handled
from afm_rl.jobs.run import Stop, begin, finish, needs_run
from afm_rl.missions import Agent
from afm_rl.missions.run import Stopped
from afm_rl.options import check_settings as check_options
from afm_rl.storage.artefacts import Checkpoints
from afm_rl.storage.files import locked
from afm_rl.storage.manifest import JOBS

ENDS = (signal.SIGINT, signal.SIGTERM)
"""Batch systems send the latter before they kill; a shell ignores the former for what it runs
behind itself."""


@dataclass(frozen=True)
class Command:
    """What a command asks for."""

    cfg: DictConfig
    """All settings."""
    overrides: Sequence[str]
    """The settings on the command line."""
    folder: Path
    """Where the results go."""
    jobs: Mapping[str, DictConfig]
    """The settings of each job, by name: of one method, with its label."""
    launcher: DictConfig
    """Hydra's launcher."""

    @property
    def is_study(self) -> bool:
        """Whether results are shown as a report, not as figures."""
        return self.cfg.get("study") is not None

    @property
    def is_single(self) -> bool:
        """Whether there is one method, which runs in this process."""
        return not self.is_study and len(self.jobs) == 1


def launch(cfg: DictConfig) -> float:
    """Run the missions of one method, of several to compare, or a study; write the results.

    Everything is built and checked before anything is trained. Each job is built once in the
    process that runs it; of several jobs each method is also built here, to see that it can be.

    Returns:
        The first measure, its mean over the missions: what optimising sweepers of Hydra look at.
    """
    command = compose(cfg)
    check(command)
    agents = build(command)
    failed = run(command, agents)
    return report(command, agents, failed)


def compose(cfg: DictConfig) -> Command:
    """Compose the settings of every job."""
    hydra = cast(DictConfig, HydraConfig.get())
    jobs, folder = jobs_of(cfg, hydra), Path(hydra.runtime.output_dir)
    return Command(cfg, list(hydra.overrides.task), folder, jobs, hydra.launcher)


def check(command: Command) -> None:
    """Check the settings that are not of the missions."""
    check_settings(command.cfg, command.overrides)


def build(command: Command) -> list[Agent]:
    """Build the agent of each method."""
    methods = {job.label: job for job in command.jobs.values()}
    return [missions.build(job) for job in methods.values()]


def run(command: Command, agents: Sequence[Agent]) -> JobsFailed | None:
    """Run what has no results yet; return what to raise once the results are shown."""
    if command.is_single:
        (job,), (agent,) = command.jobs.values(), agents
        _run_here(command, job, agent)
        return None
    launcher = instantiate(command.launcher)
    executor = getattr(launcher, "executor", None) or Executor()  # Hydra's own have none
    folder, cfg = command.folder, command.cfg
    return run_together(folder, command.jobs, executor, cfg, command.overrides)


def report(command: Command, agents: Sequence[Agent], failed: JobsFailed | None) -> float:
    """Show the results; return the mean of the first measure.

    Raises:
        JobsFailed: if some jobs have no results.
    """
    with without_collection():  # what draws takes a second to load
        from afm_rl.cli.results import first_measure, show_comparison, show_sweep

    if command.is_study or failed:
        show_sweep(command.folder, command.cfg)
    else:
        show_comparison(command.folder, command.cfg, agents)
    if failed:
        raise failed
    return first_measure([command.folder])


def check_settings(cfg: DictConfig, given: Sequence[str]) -> None:
    """Check the settings that are not of the missions.

    Args:
        cfg: all settings.
        given: those of the command line.
    """
    torch.set_num_threads(check_count("threads", cfg.threads, high=256))
    for name in ("overwrite", "progress", "figures", "tensorboard", "diagnosis"):
        check_flag(name, cfg[name])
    check_count("tensorboard_every", cfg.tensorboard_every)
    if cfg.overwrite and not values_of("overwrite", given):
        raise ConfigurationError("overwrite=True: allowed on the command line only")
    if not isinstance(cfg.cache, str):
        raise ConfigurationError(f"cache={cfg.cache!r}: expected a folder")
    check_options(Checkpoints.__init__, cfg.checkpoints)
    if cfg.video is not False:
        from afm_rl.film import check_video

        check_video(cfg.video)


def _run_here(command: Command, job: DictConfig, agent: Agent) -> None:
    """Run the missions of one method in this process."""
    folder, cfg, stop = command.folder, command.cfg, Stop()
    with _interruptible(folder), handled(stop, *ENDS), locked(folder):
        if needs_run(folder, job, cfg.overwrite):
            begin(folder, job)
            finish(folder, stop, cfg.progress, agent=agent)
        else:
            print(f"{folder} has these results already")


def run_together(
    folder: Path,
    jobs: Mapping[str, DictConfig],
    executor: Executor,
    cfg: DictConfig,
    overrides: Sequence[str],
    failures: Mapping[str, str] | None = None,
) -> JobsFailed | None:
    """Run jobs, each in a process of its own, and say which of them failed.

    Returns:
        What to raise once the results of the others are shown.
    """
    command = shlex.join(["afm-rl", *overrides])
    how: dict[str, Any] = {"command": command, "overwrite": cfg.overwrite, "progress": cfg.progress}
    with _interruptible(folder), handled(signal.default_int_handler, *ENDS):
        failed = run_batch(folder, jobs, executor, **how)
    failures = {**(failures or {}), **failed}
    for name, reason in failures.items():
        print(f"afm-rl: {name}: failed: {reason}", file=sys.stderr)
    if not failures:
        return None
    return JobsFailed(
        f"{len(failures)} of {len(failures.keys() | jobs.keys())} jobs failed "
        f"({folder / JOBS}/*/{LOG}); the same command tries them again"
    )


@contextmanager
def _interruptible(folder: Path) -> Iterator[None]:
    """End with one line and status 130 when interrupted."""
    try:
        yield
    except (KeyboardInterrupt, Stopped):
        print(
            f"afm-rl: interrupted; the results so far are in {folder}; the same command resumes "
            "if it names this folder (hydra.run.dir, or hydra.sweep.dir of a sweep)",
            file=sys.stderr,
        )
        sys.exit(130)
