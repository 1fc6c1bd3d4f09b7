"""The jobs of a sweep, each in a process of its own, and what Hydra's sweepers are told of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from afm_rl.cli.error_messages import explain
from afm_rl.cli.launch import check_settings, run_together
from afm_rl.cli.methods import check_had, jobs_of
from afm_rl.errors import AFMError
from afm_rl.jobs.executor import Executor, JobsFailed
from afm_rl.jobs.layout import job_folder
from afm_rl.trust import check_targets


def run_sweep(
    cfg: DictConfig,
    configs: Sequence[DictConfig],
    overrides: Sequence[Sequence[str]],
    executor: Executor,
) -> list[float] | JobsFailed:
    """Run jobs of a sweep; a sweep that optimises asks for some at a time.

    Args:
        cfg: the settings of the sweep.
        configs: the settings of each job of Hydra, which are several of ours where methods are
            compared.
        overrides: the overrides of each.
        executor: where jobs run.

    Returns:
        The first measure of each job of Hydra, the mean over its missions; or the failure of some,
        once the results of the others are shown.
    """
    check_settings(cfg, cfg.hydra.overrides.task)
    folder = Path(cfg.hydra.sweep.dir).absolute()
    # As text: an override may hold an interpolation that leads nowhere.
    written = cast(list, OmegaConf.to_container(cfg.hydra.overrides.task, resolve=False))
    jobs, names, failures = dict[str, DictConfig](), list[list[str]](), dict[str, str]()
    for one, given in zip(configs, overrides, strict=True):
        swept = _swept(given, written)
        try:
            composed = jobs_of(one, one.hydra, swept)
            for job in composed.values():
                check_targets(OmegaConf.to_container(job, resolve=True))
            jobs |= composed
            names.append([*composed])
        except (AFMError, HydraException, OmegaConfBaseException) as error:
            failures[" ".join(swept or given)] = explain(error) or str(error)
    check_had(sorted(set.union(*map(set, overrides))), jobs)
    failed = run_together(folder, jobs, executor, cfg, ["-m", *written], failures)
    from afm_rl.cli.results import first_measure, show_sweep

    if failed:
        show_sweep(folder, cfg)
        return failed
    direction = cfg.hydra.sweeper.get("direction")
    return [first_measure([job_folder(folder, name) for name in each], direction) for each in names]


def _swept(overrides: Sequence[str], written: Sequence[str]) -> list[str]:
    """Return the overrides of a job that differ from job to job.

    Args:
        overrides: of the job.
        written: those of the command.

    >>> _swept(["seeds=2", "planner.horizon=5"], ["seeds=2", "planner.horizon=3,5"])
    ['planner.horizon=5']
    """
    parsed = OverridesParser.create().parse_overrides(list(written))
    fixed = {each.get_key_element() for each in parsed if not each.is_sweep_override()}
    return [text for text in overrides if text.partition("=")[0] not in fixed]
