"""The tables of a study, from the shards that have results."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from afm_rl.artefacts import write_whole
from afm_rl.missions.shard import MISSIONS, Shard

CLOCKED = ["seconds"]  # columns that differ from one run to the next
COMPUTE = ("method", "missions", "steps", "seconds", "missions_per_hour", "steps_per_second")


def write_tables(study: Path, shards: Sequence[Shard]) -> pd.DataFrame:
    """Write ``missions.csv`` and ``compute.csv`` of all shards that have results.

    ``missions.csv`` has one row per mission, ordered by method, track, regime and seed. It
    holds nothing that depends on the clock, so it is the same to the byte however often the
    study was interrupted. ``compute.csv`` says what each method took.

    Args:
        study: folder of the study.
        shards: all of them, methods in the order of the tables.

    Returns:
        The missions, times included; empty if no shard has results.
    """
    done = [shard for shard in shards if shard.finished(study)]
    if not done:
        return pd.DataFrame()
    methods = list(dict.fromkeys(shard.method for shard in shards))
    texts = join([_texts(shard.folder(study) / MISSIONS) for shard in done], methods)
    missions = pd.read_csv(io.StringIO(_csv(texts)))
    write_whole(study / MISSIONS, _csv(texts.drop(columns=CLOCKED)).encode())
    write_whole(study / "compute.csv", _csv(compute(missions)).encode())
    return missions


def _texts(path: Path) -> pd.DataFrame:
    """Read a table as it is written, so that its numbers come out as they went in."""
    return pd.read_csv(path, dtype=str, keep_default_na=False)


def _csv(table: pd.DataFrame) -> str:
    return table.to_csv(index=False, lineterminator="\n")


def join(tables: Iterable[pd.DataFrame], methods: Sequence[str]) -> pd.DataFrame:
    """Put the tables of shards into one, in the order of ``methods``, missions numbered through.

    A shard's missions are its cells, in the order of tracks and regimes.

    >>> one = pd.DataFrame({"mission": [0, 1], "method": "a", "track": ["x", "y"], "seed": 7})
    >>> join([one, one.assign(seed=3)], ["a"])[["mission", "track", "seed"]].values.tolist()
    [[0, 'x', 3], [1, 'x', 7], [2, 'y', 3], [3, 'y', 7]]
    """
    whole = pd.concat(tables, ignore_index=True)
    rank = {method: place for place, method in enumerate(methods)}
    keys = pd.DataFrame(
        {
            "method": whole["method"].map(rank),
            "cell": whole["mission"].astype(int),
            "seed": whole["seed"].astype(int),
        }
    )
    order = keys.sort_values(list(keys)).index
    return whole.loc[order].assign(mission=range(len(whole))).reset_index(drop=True)


def compute(missions: pd.DataFrame) -> pd.DataFrame:
    """Return what each method took: one core's time, summed over shards.

    >>> row = {"method": "a", "steps": 99, "seconds": 0.5}
    >>> compute(pd.DataFrame([row, row])).values.tolist()
    [['a', 2, 200, 1.0, 7200.0, 200.0]]
    """
    rows = []
    for method, group in missions.groupby("method", sort=False):
        steps = int((group["steps"] + 1).sum())  # the table holds the last step's number
        seconds = float(group["seconds"].sum())
        rates = (3600 * len(group) / seconds, steps / seconds)
        rows.append((method, len(group), steps, seconds, *rates))
    return pd.DataFrame(rows, columns=list(COMPUTE))
