"""A replayed log on the terminal, as a CSV file, and as a figure and tables for a page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from afm_rl.replay import Table as Replayed
from afm_rl.replay.table import AFM, ALONE, SHARES
from afm_rl.report import style
from afm_rl.report.figures import Picture
from afm_rl.report.tables import Table
from afm_rl.storage.files import csv_text, write_whole

TITLE = "Error of predictions"
NOTE = (
    "Absolute error of what each row was predicted to do, from its command and earlier rows only: "
    "median and 90th percentile with 95 % intervals, in units of the response."
)
CAPTION = (
    "Running median of the absolute error over {rows} rows: as commanded, the plain method with "
    "the least median error, and AFM."
)


def print_replay(replayed: Replayed, file: IO[str] | None = None) -> None:
    """Print the errors over the whole log, and what a correction would have done.

    >>> from afm_rl.diagnosis import Log
    >>> from afm_rl.replay.table import errors_of
    >>> u = np.linspace(-1, 1, 40)[:, None]
    >>> log, found = Log(("pan",), u, 0.5 * u), {ALONE: u, AFM: 0.5 * u}
    >>> table = Replayed(log, found, 0 * u, errors_of(log, found), {"pan": 1.0})
    >>> print_replay(table)  # doctest: +NORMALIZE_WHITESPACE
    <BLANKLINE>
     actuator  error   as commanded       AFM
     ──────────────────────────────────────────────────────
     pan       median  0.26 [0.01, 0.50]  0.00 [0.00, 0.00]
     pan       p90     0.45 [0.37, 0.50]  0.00 [0.00, 0.00]
    <BLANKLINE>
    A correction would have removed 100 % of the error of pan.
    """
    console = Console(file=file, width=1000, highlight=False)
    grid = Grid(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    shown = errors_table(replayed, stretches=False).shown
    for head in shown:
        grid.add_column(Text(str(head)))
    for texts in shown.to_numpy():
        grid.add_row(*(Text(text) for text in texts))
    console.print(grid)
    for line in (replayed.sentence, *replayed.notes):
        console.print(Text(line), soft_wrap=True)


def errors_table(replayed: Replayed, stretches: bool = True) -> Table:
    """Return the errors, a column for each predictor: of stretches of time, or over all."""
    errors = replayed.errors
    if not stretches:
        errors = errors[errors["stretch"] == "all"]
    rows = []
    for (name, _), part in errors.groupby(["actuator", "stretch"], sort=False):
        first = part.iloc[0]
        for kind in SHARES:
            row = {"actuator": name}
            if stretches:
                row["t (s)"] = f"{first['from']:.6g} to {first['to']:.6g}"
            row["error"] = kind
            row |= {p["predictor"]: _text(p, kind) for _, p in part.iterrows()}
            rows.append(row)
    return Table("errors", TITLE, NOTE, errors, pd.DataFrame(rows))


def _text(row: pd.Series, kind: str) -> str:
    """Return an error with its interval, with two digits that count."""
    largest = row[f"{kind}_high"]
    digits = min(max(1 - int(np.floor(np.log10(largest))), 0), 9) if largest > 0 else 2
    middle, low, high = (f"{row[kind + end]:.{digits}f}" for end in ("", "_low", "_high"))
    return f"{middle} [{low}, {high}]"


def write_replay(replayed: Replayed, out: Path) -> Path:
    """Write a row for each row of the log as CSV.

    Raises:
        ConfigurationError: if it cannot be written.
    """
    write_whole(out, csv_text(replayed.rows()).encode())
    return out


def draw_replay(replayed: Replayed, most: int = 6, points: int = 300) -> tuple[Figure, str]:
    """Return the error over time of the actuators with the largest share, and a caption.

    Args:
        replayed: what to draw.
        most: actuators in the figure.
        points: of each line.
    """
    log, t = replayed.log, replayed.log.since
    whole = replayed.errors[replayed.errors["stretch"] == "all"]
    median = whole.pivot(index="actuator", columns="predictor", values="median")
    size = np.maximum(np.abs(log.command).max(0), 1e-300)
    worst = np.argsort(-median.loc[list(log.names), ALONE].to_numpy() / size, kind="stable")
    chosen = sorted(worst[:most])
    figure = style.new_figure(7.0, 0.6 + 1.4 * len(chosen))
    window = max(len(t) // 40, 5)
    rows = np.unique(np.linspace(0, len(t) - 1, points).astype(int))
    for axes, j in zip(figure.subplots(len(chosen), 1, squeeze=False)[:, 0], chosen, strict=True):
        name = log.names[j]
        plain = median.loc[name].drop([AFM, ALONE]).idxmin() if median.shape[1] > 2 else None
        looks = [(ALONE, style.FAINT), (plain, style.COLOURS[1]), (AFM, style.COLOURS[0])]
        for kind, colour in looks:
            if kind is not None:
                miss = np.abs(replayed.predictions[kind][:, j] - log.response[:, j])
                label = kind if kind != plain else "best plain method"
                axes.plot(t[rows], _running(miss, rows, window), color=colour, label=label)
        axes.set_ylabel(style.literal(name), fontsize=style.SMALL)
        axes.set_ylim(bottom=0)
        style.dress(axes)
        style.grid(axes)
    axes.set_xlabel("t (s)", fontsize=style.SMALL)
    style.legend_above(figure, *axes.get_legend_handles_labels())
    return figure, CAPTION.format(rows=window)


def _running(values: np.ndarray, rows: np.ndarray, window: int) -> list[float]:
    """Return the median of the last rows, at some of them."""
    return [float(np.median(values[max(0, row + 1 - window) : row + 1])) for row in rows]


def pictures_of(replayed: Replayed) -> Iterator[Picture]:
    """Yield the figure as a picture for a page."""
    figure, caption = draw_replay(replayed)
    yield Picture("replay", replayed.sentence, caption, style.png_bytes(figure))
