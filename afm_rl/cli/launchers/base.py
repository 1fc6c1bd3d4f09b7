"""What all launchers have in common: folders of jobs, what is done already, what failed."""

from __future__ import annotations

import importlib
import sys
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType

from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn, JobStatus, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from afm_rl.cli.launchers.job import LOG, Job
from afm_rl.errors import AFMError, ConfigurationError


class SweepError(AFMError):
    """Some jobs of a sweep have no results."""


class JobLauncher(Launcher):
    """Runs the jobs of a sweep that have no results yet, and says which failed.

    Subclasses say where, by :meth:`run`.
    """

    loader: ConfigLoader
    config: DictConfig

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.config = config

    @abstractmethod
    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, str | None]]:
        """Run jobs, in any order; yield each that is over, and why it failed, if it did."""

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs of a sweep.

        Raises:
            SweepError: if some have no results, once the others are done.
        """
        from afm_rl.cli.launchers.plan import plan  # with torch, which takes seconds

        setup_globals()
        folder = Path(self.config.hydra.sweep.dir).absolute()
        configs = [self.loader.load_sweep_config(self.config, list(o)) for o in job_overrides]
        jobs = plan(folder, configs)
        waiting = [job for job in dict.fromkeys(jobs) if not job.finished]
        before = len(set(jobs)) - len(waiting)
        print(f"{len(jobs)} jobs in {folder}" + (f", {before} with results" if before else ""))
        try:
            failures = self._work(waiting)
        except KeyboardInterrupt:
            print(f"afm-rl: interrupted; the same command goes on in {folder}", file=sys.stderr)
            sys.exit(130)
        for job in filter(failures.get, waiting):
            print(f"afm-rl: {job}: failed: {failures[job]} ({job.folder / LOG})", file=sys.stderr)
        print(f"Results: {folder}")
        if failures:
            raise SweepError(
                f"{len(failures)} of {len(jobs)} jobs failed; the same command tries them again"
            )
        return [
            JobReturn(overrides=list(overrides), cfg=cfg, status=JobStatus.COMPLETED)
            for overrides, cfg in zip(job_overrides, configs, strict=True)
        ]

    def _work(self, waiting: Sequence[Job]) -> dict[Job, str]:
        """Run jobs, tell of each that is over, and return why some failed."""
        failures = {}
        for count, (job, reason) in enumerate(self.run(waiting) if waiting else (), 1):
            print(f"[{count}/{len(waiting)}] {job}: {'failed' if reason else 'done'}", flush=True)
            if reason:
                failures[job] = reason
        return failures


def needs(package: str, extra: str) -> ModuleType:
    """Import a package that comes with one of our extras.

    Raises:
        ConfigurationError: if it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ConfigurationError(
            f"launcher: needs the package {package}: pip install 'afm-rl[{extra}]'"
        ) from error
