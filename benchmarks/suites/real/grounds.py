"""The twelve measures of the real ground robots: who predicts the motion of a window best?

    python benchmarks/suites/real/grounds.py --data DIR

DIR has `warthog_asphalt.parquet`, `warthog_gravel.parquet`, `warthog_ice.parquet`, and
`marmotte_boreal.parquet`. Each steady window of 2 s is a row: the commanded motion of the body, and
the motion that it had, v (m/s) and yaw rate (rad/s). A row is predicted from its command and from
earlier rows. Twelve measures: median and 90th percentile of the absolute error, of both axes, on
three grounds.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as parquet

from afm_rl.correction.pairs import PairCorrector
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.replay.belief import believe
from afm_rl.diagnosis.replay.simple import SIMPLE, Predictor

GROUNDS = ("warthog_asphalt", "warthog_gravel", "warthog_ice")
TRACKS = "marmotte_boreal"
NAMES = ("v", "yaw_rate")
SHARES = (0.5, 0.9)


def windows_of(file: Path) -> Log:
    """Return the steady windows of a file as a log of the body's motion, a row each."""
    table = parquet.read_table(file)
    about = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    radius, base = float(about["wheel_radius_m"]), float(about["baseline_m"])
    rows = table.to_pandas()
    rows = rows[rows["steady"]].groupby("window", sort=False).first().astype(float)
    left, right = rows["command.left"], rows["command.right"]
    motion = radius * np.column_stack([(left + right) / 2, (right - left) / base])
    response = rows[[f"window.{name}" for name in NAMES]].to_numpy()
    return Log(NAMES, motion, response)


def errors(data: Path, predict: Predictor) -> pd.Series:
    """Return median and 90th percentile of the absolute error, by ground, axis and share.

    Args:
        data: the folder.
        predict: ``predict(command, response, begins) -> prediction``, arrays ``(N, 2)``; that of a
            row may depend on its command and on earlier rows.
    """
    found = {}
    for ground in (*GROUNDS, TRACKS):
        log = windows_of(data / f"{ground}.parquet")
        miss = np.abs(predict(log.command, log.response, log.begins) - log.response)
        for name, column in zip(NAMES, miss.T, strict=True):
            for share in SHARES:
                found[ground.partition("_")[2], name, share] = float(np.quantile(column, share))
    return pd.Series(found)


def by(corrector: PairCorrector) -> Predictor:
    """Return what a corrector of two actions in [-1, 1] predicts."""

    def predict(command: np.ndarray, response: np.ndarray, begins: np.ndarray) -> np.ndarray:
        unit = np.abs(command).max(0)
        found, _ = believe(corrector, (command / unit)[:, None], (response / unit)[:, None])
        return unit * found[:, 0]

    return predict


def compare(data: Path, **others: Predictor) -> pd.DataFrame:
    """Return the errors of the simple predictors, and of others, a column each."""
    return pd.DataFrame({name: errors(data, p) for name, p in (SIMPLE | others).items()})


def twelve(data: Path, corrector: PairCorrector) -> tuple[pd.DataFrame, int]:
    """Return the table with a column ``AFM``, and in how many of the twelve it is within 10 %."""
    table = compare(data, AFM=by(corrector))
    return table, within(table, "AFM")


def within(table: pd.DataFrame, name: str, share: float = 0.1) -> int:
    """Return in how many of the twelve measures ``name`` is within a share of the best simple."""
    twelve = table.drop(TRACKS.partition("_")[2], level=0)
    return int((twelve[name] <= (1 + share) * twelve[list(SIMPLE)].min(axis=1)).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    table = compare(parser.parse_args().data)
    print(table.round(3).to_string())
    for name in table:
        print(f"{name}: within 10 % of the best simple one in {within(table, name)} of 12")


if __name__ == "__main__":
    main()
