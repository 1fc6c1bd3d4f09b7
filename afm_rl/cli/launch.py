"""From a composed configuration to a folder of results."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from afm_rl.cli.error_messages import explain
from afm_rl.cli.methods import jobs_of
from afm_rl.cli.show import report, show
from afm_rl.errors import AFMError, ConfigurationError, check_count, check_flag, check_number
from afm_rl.jobs.batch import run_batch
from afm_rl.jobs.executor import Executor, JobsFailed, LocalExecutor
from afm_rl.jobs.layout import JOBS, LOG
from afm_rl.jobs.process import handled
from afm_rl.jobs.run import Stop, begin, finish, needs_run
from afm_rl.missions import Agent, build
from afm_rl.missions.run import Stopped
from afm_rl.report import check_video
from afm_rl.storage.files import locked

SWITCHES = ("overwrite", "progress", "figures", "tensorboard")
ENDS = (signal.SIGINT, signal.SIGTERM)
"""Batch systems send the latter before they kill; a shell ignores the former for what it runs
behind itself."""


def launch(cfg: DictConfig) -> None:
    """Run the missions of one method, of several to compare, or a study; write the results.

    Everything is built and checked before anything is trained.
    """
    film = check_settings(cfg)
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    jobs = jobs_of(cfg, cast(DictConfig, hydra))
    agents = [build(job) for job in {job.label: job for job in jobs.values()}.values()]
    if cfg.get("study") is None and len(jobs) == 1:
        _run_alone(folder, next(iter(jobs.values())), agents[0])
        show(folder, cfg, agents, film)
        return
    launcher = instantiate(hydra.launcher)
    executor = getattr(launcher, "executor", None) or LocalExecutor()  # Hydra's own have none
    failed = run_together(folder, jobs, executor, cfg, hydra.overrides.task)
    if cfg.get("study") is None and not failed:
        show(folder, cfg, agents, film)
    else:
        report(folder, cfg, film)
    if failed:
        raise failed


def sweep(
    cfg: DictConfig,
    configs: Sequence[DictConfig],
    overrides: Sequence[Sequence[str]],
    executor: Executor,
) -> None:
    """Run the jobs of a sweep, and report on them.

    Args:
        cfg: the settings that all have.
        configs: those of each combination.
        overrides: what each was composed from.
        executor: where they run.

    Raises:
        JobsFailed: if some have no results, once the others are done.
    """
    film = check_settings(cfg)
    common = set.intersection(*map(set, overrides))
    jobs, failures = dict[str, DictConfig](), dict[str, str]()
    for one, given in zip(configs, overrides, strict=True):
        swept = [text for text in given if text not in common]
        try:
            found = jobs_of(one, one.hydra, swept)
            for job in found.values():
                OmegaConf.to_container(job, resolve=True)
            jobs |= found
        except (AFMError, HydraException, OmegaConfBaseException) as error:
            failures[" ".join(swept or given)] = explain(error) or str(error)
    folder = Path(cfg.hydra.sweep.dir).absolute()
    # As text: an override may hold an interpolation that leads nowhere.
    asked = cast(list, OmegaConf.to_container(cfg.hydra.overrides.task, resolve=False))
    failed = run_together(folder, jobs, executor, cfg, ["-m", *asked], failures)
    report(folder, cfg, film)
    if failed:
        raise failed


def check_settings(cfg: DictConfig) -> str | None:
    """Check the settings that are not of the missions.

    Returns:
        The format of films; None for no films.

    Raises:
        ConfigurationError: for one that cannot be used.
    """
    torch.set_num_threads(check_count("threads", cfg.threads, high=256))
    for name in SWITCHES:
        check_flag(name, cfg[name])
    if not isinstance(cfg.cache, str):
        raise ConfigurationError(f"cache={cfg.cache!r}: expected a folder")
    check_number("checkpoints.every", cfg.checkpoints.every, low=0.0)
    check_count("checkpoints.keep", cfg.checkpoints.keep)
    return check_video(cfg.video)


def _run_alone(folder: Path, cfg: DictConfig, agent: Agent) -> None:
    """Run the missions of one method in this process."""
    stop = Stop()
    with _interruptible(folder), handled(stop, *ENDS), locked(folder):
        if needs_run(folder, cfg, cfg.overwrite):
            begin(folder, cfg)
            finish(folder, agent, stop, cfg.progress)
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
    """Run jobs, and say which of them failed.

    Args:
        folder: of the batch.
        jobs: settings of each, by name.
        executor: where they run.
        cfg: settings of the command.
        overrides: of the command, for people.
        failures: jobs that could not even be composed, with reasons.

    Returns:
        What to raise once the results of the others are shown.
    """
    command = shlex.join(["afm-rl", *overrides])
    how = {"command": command, "overwrite": cfg.overwrite, "progress": cfg.progress}
    with _interruptible(folder), handled(signal.default_int_handler, *ENDS):
        found = run_batch(folder, jobs, executor, **how)
    failures = {**(failures or {}), **found}
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
            f"afm-rl: interrupted; what was done is in {folder}, and the same command goes on "
            "there, if it names this folder (hydra.run.dir, or hydra.sweep.dir of a sweep)",
            file=sys.stderr,
        )
        sys.exit(130)
