"""A run's results as files."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from afm_rl.report.comparison import draw_comparison
from afm_rl.report.events import write_events
from afm_rl.report.frames import check_frames
from afm_rl.report.learning import draw_learning
from afm_rl.report.space_plot import COLUMNS, draw_space
from afm_rl.report.style import png_bytes
from afm_rl.report.track_plot import DrawableTrack
from afm_rl.report.trajectory import draw_trajectories
from afm_rl.storage.csv_text import csv_text
from afm_rl.storage.files import write_whole
from afm_rl.storage.measures import FILE, Measures


def write_run(
    folder: str | Path,
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack] = (),
    *,
    figures: bool = True,
    tensorboard: bool = True,
    tables: bool = True,
    echo: Callable[[str], object] = print,
) -> list[Path]:
    """Write tables, figures and TensorBoard events of one method or several.

    Files: ``missions.csv``, ``measures.json``, ``steps.parquet``, ``figures/trajectory.png`` (if
    the steps have ``x`` and ``y``) or, of robots in space, ``figures/space.png``,
    ``figures/learning.png``, ``figures/summary.png`` (if a method has more than one mission), and
    event files under ``tensorboard/``. Each is written whole or not at all; files of the same name
    are replaced, others left alone.

    Args:
        folder: where to; made if it is not there.
        missions: one row per mission; mission numbers must differ over the whole frame.
        steps: one row per mission and step.
        measures: what methods are compared by.
        tracks: tracks to draw, found by name.
        figures: draw figures.
        tensorboard: write events.
        tables: write the tables; the folder of a run has them already.
        echo: receives one line per thing written.

    Returns:
        The files written.

    Raises:
        ConfigurationError: if the frames do not fit each other, or the folder cannot be
            written.
    """
    check_frames(missions, steps, measures)
    folder = Path(folder)
    written = []

    def keep(name: str, data: bytes) -> None:
        write_whole(folder / name, data)
        written.append(folder / name)
        echo(f"wrote {folder / name}")

    # The numbers come first: whatever happens to a figure, they are safe.
    if tables:
        keep("missions.csv", csv_text(missions).encode())
        keep(FILE, measures.to_json().encode())
        buffer = io.BytesIO()
        steps.to_parquet(buffer, index=False, compression="zstd")
        keep("steps.parquet", buffer.getvalue())
    if tensorboard:
        written += write_events(folder / "tensorboard", missions, steps, measures)
        echo(f"wrote {folder / 'tensorboard'} (tensorboard --logdir {folder / 'tensorboard'})")
    if figures:
        for name, draw in _drawings(missions, steps, measures, tracks).items():
            keep(f"figures/{name}.png", png_bytes(draw()))
    return written


def _drawings(
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack],
) -> dict[str, Callable[[], Figure]]:
    """Return what there is to draw, by name."""
    drawings: dict[str, Callable[[], Figure]] = {}
    if set(COLUMNS) <= set(steps):
        drawings["space"] = lambda: draw_space(missions, steps)
    elif {"x", "y"} <= set(steps):
        drawings["trajectory"] = lambda: draw_trajectories(missions, steps, measures, tracks)
    drawings["learning"] = lambda: draw_learning(missions, steps, measures.error_unit)
    if missions["method"].duplicated().any():
        drawings["summary"] = lambda: draw_comparison(missions, measures)
    return drawings
