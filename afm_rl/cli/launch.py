"""From a composed configuration to a folder of results."""

from __future__ import annotations

import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from afm_rl.cli.launchers.base import JobLauncher, JobsFailed
from afm_rl.cli.methods import jobs_of
from afm_rl.envs import load_track
from afm_rl.errors import AFMError, ConfigurationError, check_count, check_flag, check_number
from afm_rl.jobs.batch import Pool, run_batch
from afm_rl.jobs.layout import JOBS, LOG
from afm_rl.jobs.local import LocalPool
from afm_rl.jobs.run import SHOWN, Stop, begin, finish, needs_run
from afm_rl.jobs.tables import read_measures, read_missions, read_steps
from afm_rl.missions import Agent, build
from afm_rl.missions.checkpoint import Stopped
from afm_rl.missions.explained import explain_mission
from afm_rl.missions.robot import Robot
from afm_rl.report import (
    check_video,
    film_results,
    print_summary,
    write_films,
    write_report,
    write_run,
)
from afm_rl.report.diagnosis import write_diagnosis
from afm_rl.storage.files import locked
from afm_rl.storage.manifest import extend_manifest, read_manifest, write_manifest

SWITCHES = ("overwrite", "progress", "figures", "tensorboard")


def launch(cfg: DictConfig) -> None:
    """Run the missions of one method, of several to compare, or a study; write the results.

    Everything is built and checked before anything is trained.
    """
    film = check_settings(cfg)
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    jobs = jobs_of(cfg, cast(DictConfig, hydra))
    agents = {job.label: build(job) for job in {job.label: job for job in jobs.values()}.values()}
    roads = [getattr(agent.base_env, "tracks", ()) for agent in agents.values()]  # flights: none
    tracks = list({track.name: track for some in roads for track in some}.values())
    robot = next(iter(agents.values())).robot
    draw = next((getattr(agent.base_env, "draw", None) for agent in agents.values()), None)
    if cfg.get("study") is None and len(jobs) == 1:
        _run_alone(folder, next(iter(jobs.values())), next(iter(agents.values())))
        show(folder, cfg, tracks, film, robot, draw)
        return
    chosen = instantiate(hydra.launcher)  # Hydra's own launchers only know sweeps
    pool = chosen if isinstance(chosen, JobLauncher) else LocalPool()
    failed = run_together(folder, jobs, pool, cfg, hydra.overrides.task)
    if cfg.get("study") is None and not failed:
        show(folder, cfg, tracks, film, robot, draw)
    else:
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
    with _interruptible(folder), Stop().on(signal.SIGINT, signal.SIGTERM) as stop, locked(folder):
        if needs_run(folder, cfg, cfg.overwrite):
            begin(folder, cfg)
            finish(folder, agent, stop, cfg.progress)
        else:
            print(f"{folder} has these results already")


def run_together(
    folder: Path,
    jobs: Mapping[str, DictConfig],
    pool: Pool,
    cfg: DictConfig,
    overrides: Sequence[str],
    failures: Mapping[str, str] | None = None,
) -> JobsFailed | None:
    """Run jobs, and say which of them failed.

    Args:
        folder: of the batch.
        jobs: settings of each, by name.
        pool: where they run.
        cfg: settings of the command.
        overrides: of the command, for people.
        failures: jobs that could not even be composed, with reasons.

    Returns:
        What to raise once the results of the others are shown.
    """
    command = shlex.join(["afm-rl", *overrides])
    how = {"command": command, "overwrite": cfg.overwrite, "progress": cfg.progress}
    with _interruptible(folder), _ended_by(signal.SIGINT, signal.SIGTERM):
        found = run_batch(folder, jobs, pool, **how)
    failures = {**(failures or {}), **found}
    for name, reason in failures.items():
        print(f"afm-rl: {name}: failed: {reason}", file=sys.stderr)
    if not failures:
        return None
    return JobsFailed(
        f"{len(failures)} of {len(failures.keys() | jobs.keys())} jobs failed "
        f"({folder / JOBS}/*/{LOG}); the same command tries them again"
    )


def show(
    folder: Path,
    cfg: DictConfig,
    tracks: Sequence[Any],
    film: str | None,
    robot: Robot,
    draw: Any = None,
) -> None:
    """Draw the results of a run or a comparison, print their table, and explain a mission."""
    missions, steps, measures = read_missions(folder), read_steps(folder), read_measures(folder)
    with locked(folder):
        # What is drawn anew leaves the manifest first, so that this may be interrupted.
        names = [*read_manifest(folder)["files"]]
        write_manifest(folder, [name for name in names if Path(name).parts[0] not in SHOWN])
        what = {"figures": cfg.figures, "tensorboard": cfg.tensorboard, "tables": False}
        write_run(folder, missions, steps, measures, tracks, **what)
        if film is not None:
            try:
                write_films(folder / "video", missions, steps, tracks, film, draw=draw)
            except ConfigurationError as error:  # such as a robot that cannot be drawn
                print(f"afm-rl: no film: {error}", file=sys.stderr)
        explained = _explain(folder, cfg.figures, missions, steps, robot)
        extend_manifest(folder, [name for name in SHOWN if (folder / name).is_dir()])
    print_summary(missions, measures)
    print(explained, end="")
    print(f"Results: {folder}")


def _explain(
    folder: Path, page: bool, missions: pd.DataFrame, steps: pd.DataFrame, robot: Robot
) -> str:
    """Return what the first mission shows of the actuators, one line each; write the page."""
    first = missions.iloc[0]
    try:
        found, log = explain_mission(robot, steps[steps["mission"] == first["mission"]])
    except AFMError:  # such as a mission of a few steps
        return ""
    which = f"{first['method']}, {first['track']}, seed {first['seed']}"
    if page:
        list(write_diagnosis(found, log, folder / "diagnosis", which))
    return f"Actuators, by the steps of {which}:\n{found}\n"


def report(folder: Path, cfg: DictConfig, film: str | None) -> None:
    """Write the report on a sweep or a study, as far as there are results."""
    missions = read_missions(folder)
    if len(missions):
        print_summary(missions, read_measures(folder))
        try:
            write_report([folder], folder / "report", figures=cfg.figures, load_track=load_track)
            if film is not None:
                film_results([folder], folder / "report" / "video", film, load_track)
        except AFMError as error:  # such as jobs that cannot stand in one table
            print(f"afm-rl: no report: {error}", file=sys.stderr)
    print(f"Results: {folder}")


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


@contextmanager
def _ended_by(*numbers: signal.Signals) -> Iterator[None]:
    """End by signals, as by Ctrl-C: batch systems send them before they kill.

    Also by SIGINT where that is ignored, as a shell's script has it for what it runs behind itself.
    """
    before = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
