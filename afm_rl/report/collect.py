"""Result folders, read and joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from afm_rl.errors import ConfigurationError
from afm_rl.report.asked import asked_for
from afm_rl.report.frames import short_cell_names
from afm_rl.report.results_files import read_missions, read_table
from afm_rl.report.sweep import sources

KEY = ["method", "cell", "seed"]


@dataclass
class Collection:
    """What several result folders hold together.

    Attributes:
        missions: one row per mission, numbered through; beside the columns of the files it has
            ``cell`` (track and regime in words), ``file`` (place of its steps in ``files``, -1
            if they are not there) and ``own`` (its number in that file).
        files: the files of steps.
        asked: what studies were to run, one row per ``method``, ``cell``, ``seed``.
        compute: seconds and missions of each method, as studies counted them.
        notes: what a reader must know of the data, one sentence each.
    """

    missions: pd.DataFrame
    files: list[Path]
    asked: pd.DataFrame
    compute: pd.DataFrame
    notes: list[str]

    @property
    def methods(self) -> list[str]:
        """Names of the methods, in the order in which they first occur."""
        return list(self.missions["method"].unique())


def collect(folders: Sequence[str | Path]) -> Collection:
    """Read the folders of runs, sweeps and studies and join them.

    Where two folders hold the same mission (method, cell and seed), the later one counts;
    ``notes`` says so.

    Raises:
        ConfigurationError: if there is no folder, a folder holds no results, or a file cannot
            be used.
    """
    if not folders:
        raise ConfigurationError("folders=[]: expected at least one folder of results")
    files: list[Path] = []
    frames, asked, compute = [], [], []
    parts, notes = sources(folders)
    for place, source in enumerate(parts):
        folder = source.folder
        missions, own_files = _read(folder, len(files))
        files += own_files
        frames.append(source.name(missions).assign(folder=place))
        asked.append(source.name(asked_for(folder, missions)))
        if (folder / "compute.csv").is_file():
            table = read_table(folder / "compute.csv", ["method", "seconds", "missions"])
            compute.append(source.name(table)[["method", "seconds", "missions"]])
    missions = pd.concat([frame for frame in frames if len(frame)] or frames, ignore_index=True)
    if missions.empty:
        names = ", ".join(str(folder) for folder in folders)
        raise ConfigurationError(f"{names}: no mission is finished yet; expected at least one")
    if "mse" in missions and missions["mse"].isna().any():
        names = ", ".join(str(folder) for folder in folders)
        raise ConfigurationError(f"{names}: hold flights and other missions; report on each alone")
    notes += _replaced(missions, [source.folder for source in parts])
    missions = missions.drop_duplicates(KEY, keep="last").drop(columns="folder")
    missions = missions.assign(mission=range(len(missions))).reset_index(drop=True)
    without = int((missions["file"] < 0).sum())
    if without:
        notes.append(
            f"{without} of {len(missions)} missions have no steps.parquet: curves, maps and "
            "recovery times leave them out."
        )
    speed = pd.concat(compute) if compute else pd.DataFrame(columns=["seconds", "missions"])
    by_method = speed.groupby("method").sum() if compute else speed
    return Collection(missions, files, pd.concat(asked).drop_duplicates(), by_method, notes)


def _read(folder: Path, count: int) -> tuple[pd.DataFrame, list[Path]]:
    """Return a folder's missions, and the files of their steps (numbered from ``count``)."""
    shards = sorted(folder.glob("shards/*/*/missions.csv"))
    table = folder / "missions.csv"
    if not table.is_file() and not shards and not (folder / "study.yaml").is_file():
        what = "holds no missions.csv" if folder.is_dir() else "no such folder"
        raise ConfigurationError(f"{folder}: {what}; expected the folder of a run or of a study")
    parts: list[pd.DataFrame] = []
    files: list[Path] = []
    for path in [*shards, *[table] * table.is_file()]:
        part, steps = _named(path), path.with_name("steps.parquet")
        part = part.assign(own=part["mission"], file=-1)
        if steps.is_file():
            part["file"] = count + len(files)
            files.append(steps)
        parts.append(part)
    if not parts:
        return pd.DataFrame(columns=[*KEY, "file", "own"]), files
    missions = pd.concat(parts, ignore_index=True)
    if shards and table.is_file():
        # The table knows the order of the methods, the shards where the steps are. A study that
        # was killed may lack the last shards in its table, a copy of it the shards.
        missions = missions.drop_duplicates(KEY, keep="first")
        order = {name: place for place, name in enumerate(parts[-1]["method"].unique())}
        rank = missions["method"].map(order).fillna(len(order))
        missions = missions.iloc[rank.argsort(kind="stable")]
    return missions, files


def _named(path: Path) -> pd.DataFrame:
    missions = read_missions(path)
    return missions.assign(cell=short_cell_names(missions))


def _replaced(missions: pd.DataFrame, folders: Sequence[str | Path]) -> list[str]:
    """Say which missions of a folder are replaced by those of a later one."""
    lost = missions[missions.duplicated(KEY, keep="last")]
    notes = []
    for (place, method), rows in lost.groupby(["folder", "method"], sort=False):
        notes.append(
            f"{method}: {len(rows)} missions of {folders[place]} stand twice; "
            "the ones that were read last count."
        )
    return notes
