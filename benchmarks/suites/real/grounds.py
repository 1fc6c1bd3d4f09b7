"""Real ground robots: predictions of the effect of the next command.

    python benchmarks/suites/real/grounds.py --figure docs/images/three_grounds.png

A Warthog on asphalt, gravel and ice, and a tracked Marmotte (`examples/real_logs`). A row is a
steady window of 2 s: the commanded and the measured motion of the body, v (m/s) and yaw rate
(rad/s). It is predicted from its command and from earlier rows. Twelve measures: median and
90th percentile of the absolute error, of both axes, on the Warthog's three grounds. The figure
replays the three one after the other, as if the robot had driven from one to the next.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from afm_rl.correction import ActionFlow
from afm_rl.diagnosis import Log, diagnose
from afm_rl.diagnosis.readers import read_log
from afm_rl.diagnosis.replay import replay
from afm_rl.diagnosis.replay.belief import believe
from afm_rl.diagnosis.replay.table import AFM, ALONE, SIMPLE, Predictor
from afm_rl.report import style
from afm_rl.report.tables import markdown
from afm_rl.storage.files import write_whole

LOGS = Path(__file__).parents[3] / "examples" / "real_logs"
GROUNDS = ("warthog_asphalt", "warthog_gravel", "warthog_ice")
TRACKS = "marmotte_boreal"
PREFIX = "A correction would have removed "
REPLAYED = ["warthog_ice.csv", "marmotte_boreal.csv"]
REPLAYED += ["warthog_ice_wheels.parquet", "crazyflie_ramp.parquet"]
SHARES = {"median": 0.5, "p90": 0.9}


def errors(predict: Predictor) -> pd.Series:
    """Return median and 90th percentile of the absolute error, by log, axis and measure.

    Args:
        predict: ``predict(command, response, begins) -> prediction``, arrays ``(N, 2)``; that of a
            row may depend on its command and on earlier rows.
    """
    quantiles = {}
    for ground in (*GROUNDS, TRACKS):
        log = read_log(LOGS / f"{ground}.csv")
        miss = np.abs(predict(log.command, log.response, log.begins) - log.response)
        for name, column in zip(log.names, miss.T, strict=True):
            for kind, share in SHARES.items():
                quantiles[ground, name, kind] = float(np.quantile(column, share))
    return pd.Series(quantiles)


def by(corrector: ActionFlow) -> Predictor:
    """Return the predictions of a corrector of two actions in [-1, 1]."""

    def predict(command: np.ndarray, response: np.ndarray, begins: np.ndarray) -> np.ndarray:
        unit = np.abs(command).max(0)
        predicted, _ = believe(corrector, (command / unit)[:, None], (response / unit)[:, None])
        return unit * predicted[:, 0]

    return predict


def replayed(command: np.ndarray, response: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Return the predictions of ``afm-rl-diagnose --replay``."""
    return replay(Log(("v", "yaw_rate"), command, response)).predictions[AFM]


def compare(**others: Predictor) -> pd.DataFrame:
    """Return the errors of the simple predictors, and of others, a column each."""
    return pd.DataFrame({name: errors(p) for name, p in (SIMPLE | others).items()})


def within(table: pd.DataFrame, name: str, share: float = 0.1) -> int:
    """Return in how many of the twelve measures ``name`` is within a share of the best simple."""
    twelve = table.drop(TRACKS, level=0)
    return int((twelve[name] <= (1 + share) * twelve[list(SIMPLE)].min(axis=1)).sum())


def both(table: pd.DataFrame) -> pd.DataFrame:
    """Return median / 90th percentile of each ground and axis, and in how many of 12 it is good."""
    texts = table.map("{:.3f}".format)
    pairs = texts.xs("median", level=2) + " / " + texts.xs("p90", level=2)
    pairs.index = [f"{log.replace('_', ' ')}, {axis}" for log, axis in pairs.index]
    count = [str(within(table, name)) for name in table]
    pairs.loc["within 10 % of the best simple one, of 12"] = count
    return pairs.rename_axis("").reset_index()


def twelve(corrector: ActionFlow) -> tuple[pd.DataFrame, int]:
    """Return the table with a column ``AFM``, and in how many of the twelve it is within 10 %."""
    table = compare(AFM=by(corrector))
    return table, within(table, AFM)


def one_drive() -> Log:
    """Return the three grounds one after the other."""
    parts = [read_log(LOGS / f"{ground}.csv") for ground in GROUNDS]
    command, response = (
        np.concatenate([getattr(log, kind) for log in parts]) for kind in ("command", "response")
    )
    return Log(parts[0].names, command, response, 2.0 * np.arange(len(command)))


def draw(log: Log, window: int = 15) -> Figure:
    """Return the running median of the error over ``window`` rows."""
    table = replay(log)
    figure = style.new_figure(7.0, 3.6)
    for axes, j in zip(figure.subplots(2, 1, sharex=True), range(2), strict=True):
        for name in (ALONE, "affine least squares", AFM):
            miss = pd.Series(np.abs(table.predictions[name] - log.response)[:, j])
            running = miss.rolling(window, min_periods=1).median()
            axes.plot(log.seconds, running, color=style.colour_of(name), label=name)
        for k, ground in enumerate(GROUNDS):
            start = k * len(log.command) / len(GROUNDS) * 2
            axes.axvline(start, color=style.REGIME, linewidth=0.8, linestyle=":")
            if j == 0:
                text = ground.partition("_")[2]
                axes.text(start + 5, axes.get_ylim()[1], text, fontsize=style.SMALL, va="top")
        axes.set_ylabel(("v (m/s)", "yaw rate (rad/s)")[j], fontsize=style.SMALL)
        axes.set_ylim(bottom=0)
        style.dress(axes, lines="y")
    axes.set_xlabel("time on the ground (s)", fontsize=style.SMALL)
    style.legend_above(figure, *axes.get_legend_handles_labels())
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, help="where to draw the three grounds")
    options = parser.parse_args()
    print(markdown("errors", both(compare(AFM=replayed))))
    logs = {name: read_log(LOGS / name) for name in REPLAYED}
    said = []
    for name, log in logs.items():
        diagnosis = diagnose(log)
        said += [(name, note) for note in diagnosis.common]
        for actuator in diagnosis.actuators:
            said.append((f"{name}, {actuator.name}", actuator.sentence.partition(": ")[2]))
    print(markdown("diagnoses", pd.DataFrame(said, columns=["log, actuator", "what it does"])))
    heads = ["log", "what a correction would have removed"]
    removed = [
        (name, replay(log).sentence.removeprefix(PREFIX).strip(".")) for name, log in logs.items()
    ]
    print(markdown("replays", pd.DataFrame(removed, columns=heads)))
    if options.figure is not None:
        write_whole(options.figure, style.png_bytes(draw(one_drive())))


if __name__ == "__main__":
    main()
