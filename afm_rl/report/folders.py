"""The folder of one run, and of several: what is in it, checked."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.report.cells import cell_names, outcome
from afm_rl.report.stranger import read_settings, read_table, read_text
from afm_rl.storage.manifest import MANIFEST, check_manifest
from afm_rl.storage.measures import FILE, Measures

MISSIONS, STEPS, COMPUTE, RECORD = "missions.csv", "steps.parquet", "compute.csv", "jobs.yaml"
Plan = list[tuple[str, list[int]]]


def run_folders(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the folders of the runs in a folder, in the order of its record, and lost ones.

    Raises:
        ConfigurationError: if there are none.
        ArtefactError: if a file that the manifest names is damaged.
    """
    record = folder / RECORD
    jobs = {path.name: path for path in sorted((folder / "jobs").glob("*")) if path.is_dir()}
    if not jobs and not record.is_file():
        if not has_results(folder):
            what = f"holds no {MISSIONS}" if folder.is_dir() else "no such folder"
            raise ConfigurationError(
                f"{folder}: {what}; expected the folder of a run, or of several"
            )
        return [folder], []
    if (folder / MANIFEST).is_file():
        check_manifest(folder)
    named = read_settings(record).get("jobs") if record.is_file() else []
    if not isinstance(named, list):
        raise ConfigurationError(f"{record}: damaged; expected a list of jobs")
    names = [*map(str, named)]
    there = [jobs[name] for name in dict.fromkeys([*names, *jobs]) if name in jobs]
    return there, [folder / "jobs" / name for name in names if name not in jobs]


def has_results(folder: Path) -> bool:
    """Return whether a folder holds results, or did."""
    return any((folder / name).is_file() for name in (MISSIONS, MANIFEST))


def read_plan(run: Path, most: int = 100_000) -> Plan:
    """Return the method and the seeds, ``most`` at most, that a run was to have by its settings.

    Raises:
        ConfigurationError: if the settings cannot be read.
    """
    paths = [run / "config.yaml", run / "unfinished" / "config.yaml"]
    for path in (path for path in paths if path.is_file()):
        settings = read_settings(path)
        seeds = settings.get("seeds", [])
        numbers = range(seeds) if type(seeds) is int else seeds
        if not isinstance(numbers, (list, range)) or len(numbers) > most:
            raise ConfigurationError(
                f"{path}: seeds={str(seeds)[:80]}: expected a count or a list, {most} at most"
            )
        whole = [seed for seed in numbers if type(seed) is int]
        return [(str(settings["label"]), whole)] if "label" in settings else []
    return []


def read_joined_plan(folder: Path) -> Plan:
    """Return the methods and seeds of the table that a batch has of all its jobs, if it is there.

    Raises:
        ConfigurationError: if it cannot be read.
    """
    if not (folder / MISSIONS).is_file():
        return []
    asked = read_table(folder / MISSIONS, ["seed"], ["method"])
    return [(str(name), seeds.tolist()) for name, seeds in asked.groupby("method")["seed"]]


def read_measures(run: Path) -> Measures:
    """Return what the missions of a run are compared by.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it is damaged.
    """
    try:
        return Measures.from_json(read_text(run / FILE))
    except ArtefactError as error:
        raise ArtefactError(f"{run / FILE}: {error}") from error


def read_missions(run: Path, measures: Measures) -> pd.DataFrame:
    """Return the missions of a run, checked, with ``cell``, and ``seconds`` if they were counted.

    Raises:
        ConfigurationError: if a file cannot be read, a column is missing, or a value cannot be.
    """
    path, whole = run / MISSIONS, ["seed", "steps", "mission"]
    numbers = list(dict.fromkeys([*whole, *measures.columns]))
    missions = read_table(path, numbers, ["method", "track"])
    if not len(missions):
        return missions
    for name in whole:
        if missions[name].isna().any() or (missions[name] % 1 != 0).any():
            raise ConfigurationError(f"{path}: {name}: expected a whole number in each row")
    ended = outcome(missions)
    if ended not in missions or missions[ended].dtype != bool:
        raise ConfigurationError(f"{path}: {ended}: expected True or False in each row")
    if missions["mission"].duplicated().any():
        raise ConfigurationError(f"{path}: mission: expected another number in each row")
    # Single precision as text has seven digits: 6/34 is the same number in all files again.
    reals = [m.column for m in measures if pd.api.types.is_float_dtype(missions[m.column])]
    missions = missions.drop(columns="seconds", errors="ignore").assign(
        **{name: missions[name].map("{:.6g}".format).astype(float) for name in reals},
        cell=cell_names(missions),
    )
    if (run / COMPUTE).is_file():
        spent = read_table(run / COMPUTE, ["seconds", "missions"], ["method"])
        each = spent.groupby("method")[["seconds", "missions"]].sum()
        missions["seconds"] = missions["method"].map(each["seconds"] / each["missions"])
    return missions
