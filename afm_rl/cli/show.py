"""What a command shows of results: a table, figures, films, and what the actuators do."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from afm_rl.envs import load_track
from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.jobs.run import SHOWN
from afm_rl.missions import Agent
from afm_rl.missions.explained import explain_mission, planned_for
from afm_rl.report import (
    load_tracks,
    print_summary,
    read_runs,
    write_films,
    write_report,
    write_run,
)
from afm_rl.report.diagnosis import write_diagnosis
from afm_rl.storage.files import locked
from afm_rl.storage.manifest import extend_manifest, read_manifest, write_manifest


def show(folder: Path, cfg: DictConfig, agents: Sequence[Agent], film: str | None) -> None:
    """Draw the results of a run or a comparison, print their table, and explain a mission.

    Args:
        folder: of the results.
        cfg: settings of the command.
        agents: one of each method; their environments know tracks, and how a robot is drawn.
        film: the format of films; None for no films.
    """
    runs = read_runs([folder])
    missions, steps, measures = runs.missions, runs.steps(), runs.measures
    roads = [getattr(agent.base_env, "tracks", ()) for agent in agents]  # flights have none
    tracks = list({track.name: track for some in roads for track in some}.values())
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
        explained = _explain(folder, cfg.figures, missions, steps, agents[0])
        extend_manifest(folder, [name for name in SHOWN if (folder / name).is_dir()])
    print_summary(missions, measures)
    print(explained, end="")
    print(f"Results: {folder}")


def _explain(
    folder: Path, page: bool, missions: pd.DataFrame, steps: pd.DataFrame, agent: Agent
) -> str:
    """Return what the first mission shows of the actuators, one line each; write the page."""
    first = missions.iloc[0]
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
