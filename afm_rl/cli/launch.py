"""From a composed configuration to a folder of results, and what is shown of them."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from afm_rl.cli.error_messages import explain
from afm_rl.cli.methods import check_had, jobs_of
from afm_rl.cli.overrides import values_of
from afm_rl.envs import load_track
from afm_rl.errors import AFMError, ConfigurationError, check_count, check_flag
from afm_rl.film import check_video
from afm_rl.jobs.batch import run_batch
from afm_rl.jobs.executor import Executor, JobsFailed, LocalExecutor
from afm_rl.jobs.layout import LOG, is_batch
from afm_rl.jobs.process import handled
from afm_rl.jobs.run import SHOWN, Stop, begin, finish, needs_run
from afm_rl.missions import Agent, build
from afm_rl.missions.explained import explain_mission, planned_for, rank
from afm_rl.missions.run import Stopped, pace, usual_and_most
from afm_rl.options import check_settings as check_options
from afm_rl.report import (
    load_tracks,
    print_summary,
    read_runs,
    write_films,
    write_report,
    write_run,
)
from afm_rl.report.diagnosis import write_diagnosis
from afm_rl.storage.artefacts import Checkpoints
from afm_rl.storage.files import locked
from afm_rl.storage.manifest import JOBS, extend_manifest, read_manifest, write_manifest
from afm_rl.trust import check_targets

ENDS = (signal.SIGINT, signal.SIGTERM)
"""Batch systems send the latter before they kill; a shell ignores the former for what it runs
behind itself."""


def launch(cfg: DictConfig) -> None:
    """Run the missions of one method, of several to compare, or a study; write the results.

    Everything is built and checked before anything is trained.
    """
    hydra = HydraConfig.get()
    film = check_settings(cfg, hydra.overrides.task)
    folder = Path(hydra.runtime.output_dir)
    jobs = jobs_of(cfg, cast(DictConfig, hydra))
    agents = [build(job) for job in {job.label: job for job in jobs.values()}.values()]
    if cfg.get("study") is None and len(jobs) == 1:
        _run_alone(folder, next(iter(jobs.values())), agents[0])
        show(folder, cfg, agents, film)
        return
    launcher = instantiate(hydra.launcher)
    executor = getattr(launcher, "executor", None) or LocalExecutor()  # Hydra's own have none
    if cfg.overwrite or not is_batch(folder):
        print(forecast(agents, len(jobs) // len(agents)))
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
    """Run the jobs of a sweep, and report on them."""
    film = check_settings(cfg, cfg.hydra.overrides.task)
    common = set.intersection(*map(set, overrides))
    jobs, failures = dict[str, DictConfig](), dict[str, str]()
    for one, given in zip(configs, overrides, strict=True):
        swept = [text for text in given if text not in common]
        try:
            composed = jobs_of(one, one.hydra, swept)
            for job in composed.values():
                check_targets(OmegaConf.to_container(job, resolve=True))
            jobs |= composed
        except (AFMError, HydraException, OmegaConfBaseException) as error:
            failures[" ".join(swept or given)] = explain(error) or str(error)
    check_had(sorted(set.union(*map(set, overrides))), jobs)
    folder = Path(cfg.hydra.sweep.dir).absolute()
    # As text: an override may hold an interpolation that leads nowhere.
    written = cast(list, OmegaConf.to_container(cfg.hydra.overrides.task, resolve=False))
    failed = run_together(folder, jobs, executor, cfg, ["-m", *written], failures)
    report(folder, cfg, film)
    if failed:
        raise failed


def check_settings(cfg: DictConfig, given: Sequence[str]) -> str | None:
    """Check the settings that are not of the missions.

    Args:
        cfg: all settings.
        given: those of the command line.

    Returns:
        The format of films; None for no films.
    """
    torch.set_num_threads(check_count("threads", cfg.threads, high=256))
    for name in ("overwrite", "progress", "figures", "tensorboard"):
        check_flag(name, cfg[name])
    if cfg.overwrite and not values_of("overwrite", given):
        raise ConfigurationError("overwrite=True: counts on the command line only")
    if not isinstance(cfg.cache, str):
        raise ConfigurationError(f"cache={cfg.cache!r}: expected a folder")
    check_options(Checkpoints.__init__, cfg.checkpoints)
    return check_video(cfg.video)


def forecast(agents: Sequence[Agent], times: int = 1) -> str:
    """Say in a line what will run, and about how long that takes on one core, without training.

    It is seen by a few steps of each method. Where missions end with their last target, they take
    about as many steps as a healthy robot at full speed; one that does not get there takes most.

    Args:
        agents: of each method one, of no use for missions afterwards.
        times: how often each runs its missions, with other seeds.
    """
    methods = ", ".join(agent.label for agent in agents)
    tracks = ", ".join(agents[0].base_env.mission_format.tracks)
    missions = times * sum(len(agent.missions) for agent in agents)
    seconds, steps = times * sum(map(pace, agents)), dict.fromkeys(usual_and_most(agents[0]))
    spans = [f"{count:,}" for count in steps], [_duration(seconds * count) for count in steps]
    count, long = (", at most ".join(dict.fromkeys(span)) for span in spans)
    what = f"{methods} on {tracks}: {missions:,} mission{'s' * (missions > 1)}"
    return f"{what} of about {count} steps: about {long} of one core"


def _duration(seconds: float) -> str:
    """Return a time in words.

    >>> _duration(0.2), _duration(100.0), _duration(9000.0)
    ('1 s', '100 s', '150 min')
    """
    return f"{seconds / 60:,.0f} min" if seconds > 120 else f"{max(seconds, 1):.0f} s"


def _run_alone(folder: Path, cfg: DictConfig, agent: Agent) -> None:
    """Run the missions of one method in this process."""
    stop = Stop()
    with _interruptible(folder), handled(stop, *ENDS), locked(folder):
        if needs_run(folder, cfg, cfg.overwrite):
            print(forecast([agent]))
            begin(folder, cfg)
            finish(folder, stop, cfg.progress)
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

    Returns:
        What to raise once the results of the others are shown.
    """
    command = shlex.join(["afm-rl", *overrides])
    how = {"command": command, "overwrite": cfg.overwrite, "progress": cfg.progress}
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
            f"afm-rl: interrupted; what was done is in {folder}, and the same command goes on "
            "there, if it names this folder (hydra.run.dir, or hydra.sweep.dir of a sweep)",
            file=sys.stderr,
        )
        sys.exit(130)


def show(folder: Path, cfg: DictConfig, agents: Sequence[Agent], film: str | None) -> None:
    """Draw the results of a run or a comparison, print their table, and explain a mission."""
    runs = read_runs([folder])
    missions, steps, measures = runs.missions, runs.steps(), runs.measures
    roads = [getattr(agent.base_env, "tracks", ()) for agent in agents]  # flights have none
    tracks = list({track.name: track for road in roads for track in road}.values())
    with locked(folder):
        # What is drawn anew leaves the manifest first, so that this may be interrupted.
        names = [*read_manifest(folder)["files"]]
        write_manifest(folder, [name for name in names if Path(name).parts[0] not in SHOWN])
        what = {"figures": cfg.figures, "tensorboard": cfg.tensorboard}
        write_run(folder, missions, steps, measures, tracks, **what)
        if film is not None:
            draw = getattr(agents[0].base_env, "draw", None)
            try:
                write_films(folder / "video", runs, tracks, film, draw=draw)
            except ConfigurationError as error:  # such as a robot that cannot be drawn
                print(f"afm-rl: no film: {error}", file=sys.stderr)
        explained = _explain(folder, cfg.figures, missions, steps, agents)
        extend_manifest(folder, [name for name in SHOWN if (folder / name).is_dir()])
    print_summary(missions, measures)
    print(explained, end="")
    print(f"Results: {folder}")


def _explain(
    folder: Path, page: bool, missions: pd.DataFrame, steps: pd.DataFrame, agents: Sequence[Agent]
) -> str:
    """Return what a mission shows of the actuators, one line each; write the page.

    Of several methods the first that corrects is asked, AFM before what textbooks have, and none
    if none does: what a planner without correction runs into shows little of the actuators.
    """
    agent = min(agents, key=rank)
    ran = missions[missions["method"] == agent.label]
    if ran.empty or planned_for(agent) is None and len(agents) > 1:
        return ""
    first = ran.iloc[0]
    try:
        steps = steps[steps["mission"] == first["mission"]]
        found, log = explain_mission(agent.robot, steps, late=planned_for(agent))
    except AFMError:  # such as a mission of a few steps
        return ""
    which = f"{first['method']}, {first['track']}, seed {first['seed']}"
    if page:
        list(write_diagnosis(found, log, folder / "diagnosis", which))
    return f"Actuators, by the steps of {which}:\n{found}\n"


def report(folder: Path, cfg: DictConfig, film: str | None) -> None:
    """Write the report on a sweep or a study, as far as there are results."""
    try:
        runs = read_runs([folder])
        print_summary(runs.missions, runs.measures)
        tracks = load_tracks(runs.missions["track"].unique(), load_track)
        write_report(runs, folder / "report", tracks, figures=cfg.figures)
        if film is not None:
            write_films(folder / "report" / "video", runs, tracks, film)
    except AFMError as error:  # such as jobs that cannot stand in one table
        print(f"afm-rl: no report: {error}", file=sys.stderr)
    print(f"Results: {folder}")
