"""The tables of a batch, from its jobs that have results."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from afm_rl.jobs.layout import COMPUTE, MISSIONS, RECORD, STEPS, is_finished, run_folders
from afm_rl.jobs.run import csv_of
from afm_rl.storage.files import write_whole
from afm_rl.storage.manifest import MANIFEST, write_manifest
from afm_rl.storage.measures import FILE, Measures

OWN = ["run", "own"]  # the folder that a mission comes from, and its number there


def read_missions(folder: Path) -> pd.DataFrame:
    """Return the missions of a run or a batch, one per row, numbered through.

    They are ordered by method, number in the job, and seed. Beside the columns of the files there
    is ``seconds``, the job's time in equal shares; there are no rows if nothing is finished.
    """
    texts = _missions(folder)
    return pd.read_csv(io.BytesIO(csv_of(texts.drop(columns=OWN)))) if len(texts) else texts


def read_steps(folder: Path) -> pd.DataFrame:
    """Return the steps of a run or a batch, with the numbers that missions have there."""
    missions, parts = _missions(folder), []
    for run, rows in missions.groupby("run", sort=False):
        numbers = pd.Series(rows["mission"].to_numpy("int32"), rows["own"].astype(int))
        steps = pd.read_parquet(Path(str(run)) / STEPS)
        parts.append(steps.assign(mission=steps["mission"].map(numbers)))
    return pd.concat(parts, ignore_index=True)


def read_measures(folder: Path) -> Measures:
    """Return what the missions of a run or a batch are compared by.

    Raises:
        ArtefactError: if the file is damaged.
    """
    return Measures.from_json((_finished(folder)[0] / FILE).read_text())


def write_tables(folder: Path) -> None:
    """Write ``missions.csv`` and ``compute.csv`` of a batch, and its manifest.

    ``missions.csv`` holds nothing that depends on the clock, so it is the same to the byte however
    often the batch was interrupted.
    """
    (folder / MANIFEST).unlink(missing_ok=True)
    texts, done = _missions(folder), _finished(folder)
    if done:
        taken = pd.concat([pd.read_csv(run / COMPUTE) for run in done])
        whole = taken.groupby("method", sort=False).sum().reset_index()
        write_whole(folder / MISSIONS, csv_of(texts.drop(columns=[*OWN, "seconds"])))
        write_whole(folder / COMPUTE, csv_of(whole))
    write_manifest(folder, [n for n in (RECORD, MISSIONS, COMPUTE) if (folder / n).exists()])


def _finished(folder: Path) -> list[Path]:
    return [run for run in run_folders(folder) if is_finished(run) and (run / MISSIONS).exists()]


def _missions(folder: Path) -> pd.DataFrame:
    """Return the missions as text, so that numbers come out as they went in."""
    tables = []
    for run in _finished(folder):
        table = pd.read_csv(run / MISSIONS, dtype=str, keep_default_na=False)
        seconds = pd.read_csv(run / COMPUTE)["seconds"].sum() / max(len(table), 1)
        tables.append(table.assign(seconds=seconds, run=str(run), own=table["mission"]))
    return join(tables) if tables else pd.DataFrame()


def join(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Put the tables of jobs into one, missions numbered through.

    Methods keep the order in which they come first.

    >>> one = pd.DataFrame({"mission": [0, 1], "method": "a", "track": ["x", "y"], "seed": 7})
    >>> join([one, one.assign(seed=3)])[["mission", "track", "seed"]].values.tolist()
    [[0, 'x', 3], [1, 'x', 7], [2, 'y', 3], [3, 'y', 7]]
    """
    whole = pd.concat(tables, ignore_index=True)
    rank = {method: place for place, method in enumerate(whole["method"].unique())}
    keys = pd.DataFrame(
        {
            "method": whole["method"].map(rank),
            "cell": whole["mission"].astype(int),
            "seed": whole["seed"].astype(int),
        }
    )
    order = keys.sort_values(list(keys), kind="stable").index
    return whole.loc[order].assign(mission=range(len(whole))).reset_index(drop=True)
