"""The tables of a batch, from its jobs that have results."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from afm_rl.jobs.layout import COMPUTE, MISSIONS, RECORD, is_finished, job_folders
from afm_rl.jobs.run import csv_of
from afm_rl.storage.files import write_whole
from afm_rl.storage.manifest import MANIFEST, write_manifest


def write_tables(folder: Path) -> None:
    """Write ``missions.csv`` and ``compute.csv`` of a batch, and its manifest.

    ``missions.csv`` holds nothing that depends on the clock, so it is the same to the byte however
    often the batch was interrupted.
    """
    (folder / MANIFEST).unlink(missing_ok=True)
    runs = [run for run in job_folders(folder) if is_finished(run) and (run / MISSIONS).exists()]
    if runs:
        # As text, so that numbers come out as they went in.
        texts = [pd.read_csv(run / MISSIONS, dtype=str, keep_default_na=False) for run in runs]
        taken = pd.concat([pd.read_csv(run / COMPUTE) for run in runs])
        whole = taken.groupby("method", sort=False).sum().reset_index()
        write_whole(folder / MISSIONS, csv_of(join(texts)))
        write_whole(folder / COMPUTE, csv_of(whole))
    write_manifest(folder, [n for n in (RECORD, MISSIONS, COMPUTE) if (folder / n).exists()])


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
