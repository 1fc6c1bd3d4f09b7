"""Hydra's side of jobs: the launcher that ``conf/launcher`` names."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, env_override, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from afm_rl.errors import check_choice
from afm_rl.imports import without_collection
from afm_rl.jobs.executor import LocalExecutor, SubmititExecutor

NAMESPACE = "hydra_plugins"


class JobLauncher(Launcher):
    """Runs jobs, those of a sweep as well as those of a comparison or a study.

    Args:
        executor: ``local`` or ``submitit``.
        **settings: of the :class:`~afm_rl.jobs.executor.Executor`.

    Raises:
        ConfigurationError: for settings that cannot be used, or if a package is not installed.
    """

    loader: ConfigLoader
    config: DictConfig

    def __init__(self, executor: str, **settings: Any) -> None:
        super().__init__()
        kinds = {"local": LocalExecutor, "submitit": SubmititExecutor}
        kind = check_choice("hydra.launcher.executor", executor, kinds)
        self.executor = kinds[kind](**settings)

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.config = config

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs of a sweep and report on them, see :func:`afm_rl.cli.launch.sweep`."""
        with without_collection():  # with torch, which takes seconds
            from afm_rl.cli.launch import sweep

        setup_globals()
        overrides = [list(each) for each in job_overrides]
        configs = [self.loader.load_sweep_config(self.config, each) for each in overrides]
        with env_override(self.config.hydra.job.env_set):
            sweep(self.config, configs, overrides, self.executor)
        return [
            JobReturn(overrides=each, cfg=cfg, status=JobStatus.COMPLETED)
            for each, cfg in zip(overrides, configs, strict=True)
        ]


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
    JobLauncher.__module__ = f"{NAMESPACE}.afm_rl"
    Plugins.instance().register(JobLauncher)
