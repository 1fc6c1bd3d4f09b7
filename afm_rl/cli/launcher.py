"""Hydra's side of sweeps: the launchers of ``conf/hydra/launcher``, and the report at the end."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, env_override, setup_globals
from hydra.experimental.callback import Callback
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from afm_rl.imports import without_collection
from afm_rl.jobs.executor import Executor

NAMESPACE = "hydra_plugins"
NAME = f"{NAMESPACE}.afm_rl"


class FailedJob(JobReturn):
    """A job without a result. Hydra's own class also prints what was already said."""

    @property
    def return_value(self) -> Any:
        raise self._return_value

    @return_value.setter
    def return_value(self, value: Any) -> None:
        self._return_value = value


class JobLauncher(Launcher):
    """Runs jobs, those of a sweep as well as those of a comparison or a study.

    Each job is a process of its own. What sweepers are told of a job is the first measure of its
    missions.

    Args:
        **settings: of the :class:`~afm_rl.jobs.executor.Executor`.

    Raises:
        ConfigurationError: for settings that cannot be used.
    """

    loader: ConfigLoader
    config: DictConfig

    def __init__(self, **settings: Any) -> None:
        super().__init__()
        self.executor = Executor(**settings)

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.config = config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run jobs of a sweep, see :func:`afm_rl.cli.sweep.run_sweep`."""
        with without_collection():  # with torch, which takes seconds
            from afm_rl.cli.sweep import run_sweep

        setup_globals()
        overrides = [list(each) for each in job_overrides]
        configs = [self.loader.load_sweep_config(self.config, each) for each in overrides]
        with env_override(self.config.hydra.job.env_set):
            found = run_sweep(self.config, configs, overrides, self.executor)
        if isinstance(found, Exception):
            failed = FailedJob(status=JobStatus.FAILED)
            failed.return_value = found
            return [failed] * len(overrides)
        done = []
        for each, cfg, value in zip(overrides, configs, found, strict=True):
            done.append(JobReturn(overrides=each, cfg=cfg, status=JobStatus.COMPLETED))
            done[-1].return_value = value
        return done


class SweepReport(Callback):
    """Writes the report on a sweep of ours when all its jobs are over."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        if config.hydra.launcher._target_.startswith(NAME):
            from afm_rl.cli.results import show_sweep

            show_sweep(Path(config.hydra.sweep.dir).absolute(), config)


def register() -> None:
    """Make the launcher known to Hydra as ``hydra_plugins.afm_rl``, in this process only.

    Hydra takes launchers from that namespace alone; what is installed there is loaded by every
    Hydra application, so nothing of ours is.
    """
    try:
        namespace = importlib.import_module(NAMESPACE)
    except ModuleNotFoundError:
        namespace = sys.modules[NAMESPACE] = ModuleType(NAMESPACE)
        namespace.__path__ = []
    vars(namespace)["afm_rl"] = sys.modules[__name__]
    JobLauncher.__module__ = NAME
    Plugins.instance().register(JobLauncher)
