"""Folders of results, checked, become one table: all that a report shows is a view of it."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.report.untrusted import read_numbers, read_table, read_text
from afm_rl.storage.files import read_settings
from afm_rl.storage.manifest import (
    COMPUTE,
    JOBS,
    MANIFEST,
    MISSIONS,
    RECORD,
    STEPS,
    check_manifest,
)
from afm_rl.storage.measures import FILE, Measures

KEY = ["method", "scenario", "seed"]


def outcome(columns: Container[str]) -> str:
    """Return the name of the column that says how missions ended.

    ``finished`` where there is a goal to reach; otherwise ``terminated``, whether the episode
    ended before its time.

    >>> outcome(["steps", "terminated"])
    'terminated'
    """
    return "terminated" if "terminated" in columns else "finished"


def scenario_names(missions: pd.DataFrame) -> pd.Series:
    """Return each mission's scenario: its track and regime, in words.

    The regime is what the column ``regime`` calls it; without one, its parameters, the columns
    between track and seed, but for gains of 1.

    >>> row = {"method": "physics", "track": "oval", "v_gain": 1.0, "seed": 0}
    >>> scenario_names(pd.DataFrame([row, row | {"v_gain": -1.0}])).tolist()
    ['oval, nominal', 'oval, v_gain = -1']
    >>> scenario_names(pd.DataFrame([row | {"regime": "slip"}])).tolist()
    ['oval, slip']
    """
    tracks = missions["track"].astype(str)
    if "regime" in missions:
        # A family draws its parameters again for each seed: only its name is the same.
        return (tracks + ", " + missions["regime"].astype(str)).rename("scenario")
    regimes, names = pd.Series("", index=missions.index), list(missions)
    for name in names[names.index("track") + 1 : names.index("seed")]:
        regimes += missions[name].map(f", {name} = {{:g}}".format)
    regimes = regimes.str.replace(r", \w*gain = 1(?=,|$)", "", regex=True)
    return (tracks + regimes.where(regimes != "", ", nominal")).rename("scenario")


def with_scenarios(missions: pd.DataFrame) -> pd.DataFrame:
    """Return the missions with a column ``scenario``."""
    return (
        missions if "scenario" in missions else missions.assign(scenario=scenario_names(missions))
    )


def steps_of(steps: pd.DataFrame, missions: Iterable[int]) -> dict[int, pd.DataFrame]:
    """Return the steps of some missions, by mission.

    >>> steps = pd.DataFrame({"mission": [0, 0, 1, 2], "t": [0, 1, 0, 0]})
    >>> {number: len(rows) for number, rows in steps_of(steps, [0, 2]).items()}
    {0: 2, 2: 1}
    """
    chosen = steps[steps["mission"].isin(list(missions))]
    return dict(iter(chosen.groupby("mission", sort=False)))


def action_names(steps: pd.DataFrame) -> list[str]:
    """Return the names of the action's components.

    >>> action_names(pd.DataFrame(columns=["x", "planned_v", "executed_v"]))
    ['v']
    """
    return [name.removeprefix("planned_") for name in steps if name.startswith("planned_")]


def run_folders(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the folders of the runs in a folder, in the order of its record, and lost ones."""
    record = folder / RECORD
    jobs = {path.name: path for path in sorted((folder / JOBS).glob("*")) if path.is_dir()}
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
    return there, [folder / JOBS / name for name in names if name not in jobs]


def has_results(folder: Path) -> bool:
    """Return whether a folder holds results, or did."""
    return any((folder / name).is_file() for name in (MISSIONS, MANIFEST))


def read_measures(run: Path) -> Measures:
    """Return what the missions of a run are compared by."""
    try:
        return Measures.from_json(read_text(run / FILE))
    except ArtefactError as error:
        raise ArtefactError(f"{run / FILE}: {error}") from error


def read_missions(run: Path, measures: Measures) -> pd.DataFrame:
    """Return the missions of a run, checked, with ``scenario``, and ``seconds`` if known."""
    path, counts = run / MISSIONS, ["seed", "steps", "mission"]
    numbers = list(dict.fromkeys([*counts, *measures.columns]))
    missions = read_table(path, numbers, ["method", "track"])
    if not len(missions):
        return missions
    for name in counts:
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
        scenario=scenario_names(missions),
    )
    if (run / COMPUTE).is_file():
        spent = read_table(run / COMPUTE, ["seconds", "missions"], ["method"])
        each = spent.groupby("method")[["seconds", "missions"]].sum()
        missions["seconds"] = missions["method"].map(each["seconds"] / each["missions"])
    return missions


@dataclass(frozen=True)
class Runs:
    """The results of one folder, or of several together.

    Attributes:
        folders: where they were read.
        missions: one row per mission, numbered through. Beside the columns of the files there are
            ``scenario`` (track and regime in words), ``seconds`` (the time of its run in equal
            shares, where it was counted), ``file`` (place of its steps in ``files``, -1 if there
            are none) and ``own`` (its number in that file).
        measures: measures for the comparison.
        files: the files of steps.
        notes: notes about the data, one sentence each.
        lost: a message for each job that ``jobs.yaml`` names but that has no results.
    """

    folders: list[Path]
    missions: pd.DataFrame
    measures: Measures
    files: list[Path]
    notes: list[str]
    lost: list[str]

    @property
    def methods(self) -> list[str]:
        """Names of the methods, in order of first occurrence."""
        return list(self.missions["method"].unique())

    @property
    def with_steps(self) -> pd.DataFrame:
        """The missions with steps."""
        return self.missions[self.missions["file"] >= 0]

    @property
    def missing(self) -> pd.DataFrame:
        """What is missing, one row per ``method``, ``scenario`` and ``seed``.

        Complete means that every method has each scenario and seed that any method has.
        """
        there = dict.fromkeys(zip(*(self.missions[name] for name in KEY), strict=True))
        places = dict.fromkeys((scenario, seed) for _, scenario, seed in there)
        rows = ((method, *place) for method in self.methods for place in places)
        return pd.DataFrame([row for row in rows if row not in there], columns=KEY)

    def steps(
        self, missions: pd.DataFrame | None = None, columns: Sequence[str] | None = None
    ) -> pd.DataFrame:
        """Return steps, one row per mission and step, in their order.

        Args:
            missions: rows of the table of missions; None: all.
            columns: columns to read in addition to ``mission`` and ``t``; a column that a file
                lacks is NaN. None: all.

        Raises:
            ConfigurationError: if a file cannot be read, or holds something else than numbers.
        """
        rows = self.with_steps if missions is None else missions[missions["file"] >= 0]
        names = None if columns is None else list(dict.fromkeys(["mission", "t", *columns]))
        tables = []
        for place, group in rows.groupby("file"):
            number = group.set_index("own")["mission"].astype("int32")
            table = read_numbers(self.files[place], number.index.tolist(), names)
            tables.append(table.assign(mission=table["mission"].map(number)))
        joined = pd.concat(tables) if tables else pd.DataFrame(columns=names or ["mission", "t"])
        ordered = joined.reindex(columns=names or list(joined))
        return ordered.sort_values(["mission", "t"], ignore_index=True)


def read_runs(folders: Sequence[str | Path]) -> Runs:
    """Read the folders of runs, comparisons, sweeps and studies, and join them.

    Files that a manifest names are checked against it first. Where two folders hold the same
    mission (method, scenario and seed), the later one counts; ``notes`` says so.

    Raises:
        ConfigurationError: if there is no folder, a folder holds no results or results of another
            kind of mission, or a file cannot be used.
        ArtefactError: if a file is damaged.
    """
    if not folders:
        raise ConfigurationError("folders=[]: expected at least one folder of results")
    paths, names = [Path(folder) for folder in folders], ", ".join(map(str, folders))
    files: list[Path] = []
    tables: list[pd.DataFrame] = []
    notes: list[str] = []
    lost: list[str] = []
    measures: Measures | None = None
    # Each run is checked and read; its steps stay in their file.
    for place, folder in enumerate(paths):
        runs, gone = run_folders(folder)
        if runs != [folder] and not (folder / MANIFEST).is_file():
            notes.append(f"{folder} has no {MANIFEST}: missing jobs cannot be detected.")
        again = (
            f"missing, although {RECORD} names it; the command that made the folder runs it again"
        )
        lost += [f"{job}: {again}" for job in gone]
        for run in runs:
            if not has_results(run):
                notes.append(f"{run} has no results yet.")
                continue
            check_manifest(run)
            declared = read_measures(run)
            if declared != (measures or declared):
                raise ConfigurationError(
                    f"{names}: hold missions of different kinds; report on each separately"
                )
            measures, missions = declared, read_missions(run, declared)
            missions = missions.assign(own=missions["mission"], file=-1, folder=place)
            if (run / STEPS).is_file():
                missions["file"] = len(files)
                files.append(run / STEPS)
            tables.append(missions)
    tables = [table for table in tables if len(table)]
    if measures is None or not tables:
        said = f" ({'; '.join(lost)})" if lost else ""
        raise ConfigurationError(
            f"{names}: no mission is finished yet; expected at least one{said}"
        )
    # What stands in two folders counts once.
    missions = pd.concat(tables, ignore_index=True)
    twice = missions[missions.duplicated(KEY, keep="last")]
    notes += [
        f"{method}: {len(rows)} missions of {paths[place]} are there twice; "
        "those that were read last count."
        for (place, method), rows in twice.groupby(["folder", "method"], sort=False)
    ]
    missions = missions.drop_duplicates(KEY, keep="last")
    # Seeds stand side by side, also where each is a job of its own.
    missions = missions.assign(rank=pd.factorize(missions["method"])[0])
    missions = missions.sort_values(["rank", "folder", "own", "seed"], kind="stable")
    missions = missions.assign(mission=range(len(missions))).reset_index(drop=True)
    missions = missions.drop(columns=["folder", "rank"])
    if without := int((missions["file"] < 0).sum()):
        notes.append(
            f"{without} of {len(missions)} missions have no {STEPS}: curves, maps and "
            "recovery times exclude them."
        )
    return Runs(paths, missions, measures, files, notes, lost)
