"""What all launchers have in common: Hydra's side of a sweep."""

from __future__ import annotations

import importlib
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import cast

from hydra.core.config_loader import ConfigLoader
from hydra.core.utils import JobReturn, JobStatus, setup_globals
from hydra.errors import HydraException
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from afm_rl.cli.error_messages import explain
from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.jobs.process import Ends, Job


class JobsFailed(AFMError):
    """Some jobs have no results."""


class JobLauncher(Launcher):
    """Runs jobs, those of a sweep as well as those of a comparison or a study.

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
    def run(self, jobs: Sequence[Job]) -> Ends:
        """Run jobs, as :class:`afm_rl.jobs.batch.Pool` says."""

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs of a sweep and report on them.

        Raises:
            JobsFailed: if some have no results, once the others are done.
        """
        from afm_rl.cli import launch  # with torch, which takes seconds
        from afm_rl.cli.methods import jobs_of

        setup_globals()
        film = launch.check_settings(self.config)
        configs = [self.loader.load_sweep_config(self.config, list(o)) for o in job_overrides]
        common = set.intersection(*map(set, job_overrides))
        jobs: dict[str, DictConfig] = {}
        failures = {}
        for cfg, overrides in zip(configs, job_overrides, strict=True):
            swept = [text for text in overrides if text not in common]
            try:
                found = jobs_of(cfg, cfg.hydra, swept)
                for job in found.values():
                    OmegaConf.to_container(job, resolve=True)
                jobs |= found
            except (AFMError, HydraException, OmegaConfBaseException) as error:
                failures[" ".join(swept or overrides)] = explain(error) or str(error)
        folder = Path(self.config.hydra.sweep.dir).absolute()
        # As text: an override may hold an interpolation that leads nowhere.
        asked = OmegaConf.to_container(self.config.hydra.overrides.task, resolve=False)
        failed = launch.run_together(
            folder, jobs, self, self.config, ["-m", *cast(list, asked)], failures
        )
        launch.report(folder, self.config, film)
        if failed:
            raise failed
        return [
            JobReturn(overrides=list(overrides), cfg=cfg, status=JobStatus.COMPLETED)
            for overrides, cfg in zip(job_overrides, configs, strict=True)
        ]


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
