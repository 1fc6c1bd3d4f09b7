"""Result folders, read and joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from afm_rl.errors import ConfigurationError
from afm_rl.report.frames import cell_names
from afm_rl.report.results_files import read_measures, read_missions, read_settings, read_table
from afm_rl.storage.manifest import MANIFEST, check_manifest
from afm_rl.storage.measures import FILE, Measures

KEY = ["method", "cell", "seed"]
MOST_SEEDS = 100_000  # of a method


@dataclass
class Collection:
    """What several result folders hold together.

    Attributes:
        missions: one row per mission, numbered through; beside the columns of the files it has
            ``cell`` (track and regime in words), ``file`` (place of its steps in ``files``, -1
            if they are not there) and ``own`` (its number in that file).
        measures: what methods are compared by.
        files: the files of steps.
        plan: what was to be run, one row per ``method``, ``cell``, ``seed``.
        compute: seconds and missions of each method, where runs counted them.
        notes: what a reader must know of the data, one sentence each.
    """

    missions: pd.DataFrame
    measures: Measures
    files: list[Path]
    plan: pd.DataFrame
    compute: pd.DataFrame
    notes: list[str]

    @property
    def methods(self) -> list[str]:
        """Names of the methods, in the order in which they first occur."""
        return list(self.missions["method"].unique())


def collect(folders: Sequence[str | Path]) -> Collection:
    """Read the folders of runs, comparisons, sweeps and studies and join them.

    Where two folders hold the same mission (method, cell and seed), the later one counts;
    ``notes`` says so.

    Raises:
        ConfigurationError: if there is no folder, a folder holds no results or results of another
            kind of mission, or a file cannot be used.
        ArtefactError: if a file is damaged.
    """
    if not folders:
        raise ConfigurationError("folders=[]: expected at least one folder of results")
    names = ", ".join(str(folder) for folder in folders)
    files: list[Path] = []
    tables, plans, compute, notes = [], [], [], []
    measures: Measures | None = None
    for place, folder in enumerate(map(Path, folders)):
        for run in run_folders(folder):
            if not any((run / name).is_file() for name in ("missions.csv", MANIFEST)):
                notes.append(f"{run} has no results yet.")
                plans.append(_plan(run))
                continue
            check_manifest(run)
            plans.append(_plan(run))
            declared = read_measures(run / FILE)
            if declared != (measures or declared):
                raise ConfigurationError(
                    f"{names}: hold missions of different kinds; report on each alone"
                )
            measures = declared
            missions = read_missions(run / "missions.csv", measures)
            missions = missions.assign(own=missions["mission"], file=-1, folder=place)
            if (run / "steps.parquet").is_file():
                missions["file"] = len(files)
                files.append(run / "steps.parquet")
            tables.append(missions.assign(cell=cell_names(missions)))
            if (run / "compute.csv").is_file():
                spent = read_table(run / "compute.csv", ["seconds", "missions"], ["method"])
                compute.append(spent[["method", "seconds", "missions"]])
    if measures is None or all(table.empty for table in tables):
        raise ConfigurationError(f"{names}: no mission is finished yet; expected at least one")
    missions = pd.concat([table for table in tables if len(table)], ignore_index=True)
    notes += _replaced(missions, folders)
    missions = missions.drop_duplicates(KEY, keep="last").drop(columns="folder")
    order = {name: place for place, name in enumerate(missions["method"].unique())}
    missions = missions.sort_values("method", key=lambda names: names.map(order), kind="stable")
    missions = missions.assign(mission=range(len(missions))).reset_index(drop=True)
    without = int((missions["file"] < 0).sum())
    if without:
        notes.append(
            f"{without} of {len(missions)} missions have no steps.parquet: curves, maps and "
            "recovery times leave them out."
        )
    speed = pd.concat([pd.DataFrame(columns=["method", "seconds", "missions"]), *compute])
    spent = speed.astype({"seconds": float, "missions": float}).groupby("method").sum()
    return Collection(missions, measures, files, _cross(plans, missions), spent, notes)


def run_folders(folder: Path) -> list[Path]:
    """Return the folders of the runs in a folder, in the order of its ``jobs.yaml``.

    Raises:
        ConfigurationError: if there are none.
    """
    jobs = [path for path in (folder / "jobs").glob("*") if path.is_dir()]
    if jobs:
        record = folder / "jobs.yaml"
        named = read_settings(record).get("jobs") if record.exists() else []
        if not isinstance(named, list):
            raise ConfigurationError(f"{record}: damaged; expected a list of jobs")
        rank = {str(name): place for place, name in enumerate(named)}
        return sorted(jobs, key=lambda path: (rank.get(path.name, len(rank)), path.name))
    if not any((folder / name).is_file() for name in ("missions.csv", MANIFEST)):
        what = "holds no missions.csv" if folder.is_dir() else "no such folder"
        raise ConfigurationError(f"{folder}: {what}; expected the folder of a run, or of several")
    return [folder]


def _plan(run: Path) -> tuple[list[str], list[int]]:
    """Return the methods and seeds that a run was to have, as its settings say."""
    paths = [run / "config.yaml", run / "unfinished" / "config.yaml"]
    for path in (path for path in paths if path.is_file()):
        settings = read_settings(path)
        return [str(settings.get("label"))] * ("label" in settings), _seeds(path, settings)
    return [], []


def _seeds(path: Path, settings: dict[str, Any]) -> list[int]:
    seeds = settings.get("seeds", [])
    numbers = range(seeds) if type(seeds) is int else seeds
    if not isinstance(numbers, (list, range)) or len(numbers) > MOST_SEEDS:
        raise ConfigurationError(
            f"{path}: seeds={str(seeds)[:80]}: expected a count or a list, {MOST_SEEDS} at most"
        )
    return [seed for seed in numbers if type(seed) is int]


def _cross(plans: Sequence[tuple[list[str], list[int]]], missions: pd.DataFrame) -> pd.DataFrame:
    """Return every cell that there is with each method and seed of the plans."""
    cells = list(missions["cell"].unique())
    rows = [row for methods, seeds in plans for row in product(methods, cells, seeds)]
    return pd.DataFrame(rows, columns=KEY).drop_duplicates()


def _replaced(missions: pd.DataFrame, folders: Sequence[str | Path]) -> list[str]:
    """Say which missions of a folder are replaced by those of a later one."""
    lost = missions[missions.duplicated(KEY, keep="last")]
    return [
        f"{method}: {len(rows)} missions of {folders[place]} stand twice; "
        "the ones that were read last count."
        for (place, method), rows in lost.groupby(["folder", "method"], sort=False)
    ]
