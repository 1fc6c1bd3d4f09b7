"""What a command shows of its results: figures, films and tables, a report, a diagnosis."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from afm_rl.envs import load_track
from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.film import check_video
from afm_rl.imports import without_collection
from afm_rl.jobs.run import DRAWN, SHOWN, TENSORBOARD
from afm_rl.missions import Agent
from afm_rl.report import (
    load_tracks,
    print_summary,
    read_runs,
    write_films,
    write_report,
    write_run,
)
from afm_rl.storage.files import locked
from afm_rl.storage.manifest import extend_manifest, read_manifest, write_manifest


def first_measure(folders: Sequence[Path], direction: object = None) -> float:
    """Return the first measure of the missions in some folders, the mean over all of them.

    Args:
        folders: of runs.
        direction: in which a sweeper looks for better values, if it does: minimize or maximize.

    Raises:
        ConfigurationError: if that is the direction of worse values.
    """
    runs = read_runs(folders)
    measure = next(iter(runs.measures))
    wanted = "maximize" if measure.better == "higher" else "minimize"
    given = getattr(direction, "name", direction)  # of an enumeration
    if given in ("minimize", "maximize") and given != wanted:
        raise ConfigurationError(
            f"hydra.sweeper.direction={given}: a {measure.better} "
            f"{measure.column} is better; give hydra.sweeper.direction={wanted}"
        )
    return float(runs.missions[measure.column].mean())


def show_comparison(folder: Path, cfg: DictConfig, agents: Sequence[Agent]) -> None:
    """Draw the results of a run or a comparison, and print their table."""
    runs = read_runs([folder])
    missions, steps, measures = runs.missions, runs.steps(), runs.measures
    roads = [getattr(agent.base_env, "tracks", ()) for agent in agents]  # flights have none
    tracks = list({track.name: track for road in roads for track in road}.values())
    explained = ""
    with locked(folder):
        # What is drawn again leaves the manifest first, so that this may be interrupted.
        names = [*read_manifest(folder)["files"]]
        write_manifest(folder, [name for name in names if Path(name).parts[0] not in DRAWN])
        if cfg.figures:
            write_run(folder, missions, steps, measures, tracks)
        if film := check_video(cfg.video):
            draw = getattr(agents[0].base_env, "draw", None)
            try:
                write_films(folder / "video", runs, tracks, film, draw=draw)
            except ConfigurationError as error:  # such as a robot that cannot be drawn
                print(f"afm-rl: no film: {error}", file=sys.stderr)
        if cfg.diagnosis:
            explained = _explain(folder, missions, steps, agents)
        extend_manifest(folder, [name for name in SHOWN if (folder / name).is_dir()])
    if cfg.tensorboard:
        print(f"Curves: tensorboard --logdir {folder / TENSORBOARD}")
    print_summary(missions, measures)
    print(explained, end="")
    print(f"Results: {folder}")


def _explain(
    folder: Path, missions: pd.DataFrame, steps: pd.DataFrame, agents: Sequence[Agent]
) -> str:
    """Return what a mission shows of the actuators, one line each; write the page.

    Of several methods the first that corrects is asked, AFM before what textbooks have, and none
    if none does: what a planner without correction runs into shows little of the actuators.
    """
    with without_collection():
        from afm_rl.missions.explained import explain_mission, planned_for, rank
        from afm_rl.report.diagnosis import write_diagnosis

    agent = min(agents, key=rank)
    ran = missions[missions["method"] == agent.label]
    if planned_for(agent) is None and len(agents) > 1:
        return "No diagnosis: none of these methods corrects\n"
    first = ran.iloc[0]
    try:
        steps = steps[steps["mission"] == first["mission"]]
        found, log = explain_mission(agent.robot, steps, late=planned_for(agent))
    except AFMError as error:  # such as a mission of a few steps
        return f"No diagnosis: {error}\n"
    which = f"{first['method']}, {first['track']}, seed {first['seed']}"
    list(write_diagnosis(found, log, folder / "diagnosis", which))
    return f"Actuators, by the steps of {which}:\n{found}\n"


def show_sweep(folder: Path, cfg: DictConfig) -> None:
    """Write the report on a sweep or a study, as far as there are results."""
    try:
        runs = read_runs([folder])
        print_summary(runs.missions, runs.measures)
        tracks = load_tracks(runs.missions["track"].unique(), load_track)
        write_report(runs, folder / "report", tracks, figures=cfg.figures)
        if film := check_video(cfg.video):
            write_films(folder / "report" / "video", runs, tracks, film)
    except AFMError as error:  # such as jobs that cannot stand in one table
        print(f"afm-rl: no report: {error}", file=sys.stderr)
    print(f"Results: {folder}")
