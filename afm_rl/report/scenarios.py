"""Error and loss of every method, cell by cell."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from afm_rl.report import style
from afm_rl.report.curve import ENDS, STARTS, draw_curve, mark_regime
from afm_rl.report.frames import steps_of
from afm_rl.report.learning import last_step, scale_panel

COLUMNS, ROWS = 3, 4  # panels on a page
FEW = 6  # methods in a panel; lines that mark the changes of more would hide the curves
LABELS = {"error": "prediction error per step (m, rad)", "loss": "model loss (NLL)"}
TITLES = {"error": "Prediction error", "loss": "Model loss"}
CAPTION = (
    "{what} against the step, one panel per cell on {track}, one seed (page {page} of {pages}). "
    "Lines are moving averages over 20 steps. Triangles at the upper edge (with a thin line below "
    "if there are few methods) mark where each method's changed regime starts (pointing right) and "
    "ends (pointing left): the sooner they come, the faster the method drove. An axis ends soon "
    "after the last mission that finished. {read}"
)
READ = {
    "error": "Low soon after a mark: the model has caught up. A frozen model never does.",
    "loss": "Losses of different kinds of model (with and without a learnt variance) do not "
    "compare; peaks and how long they last do.",
}


def traced_missions(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one mission per method and cell: the seed that most methods of the cell have.

    >>> rows = {"method": ["a", "a", "b"], "cell": ["oval"] * 3, "seed": [0, 1, 1]}
    >>> traced_missions(pd.DataFrame(rows))["seed"].tolist()
    [1, 1]
    """
    count = missions.groupby(["cell", "seed"])["method"].nunique().reset_index()
    count = count.sort_values(["method", "seed"], ascending=[False, True])
    chosen = count.drop_duplicates("cell")[["cell", "seed"]]
    return missions.merge(chosen, on=["cell", "seed"])


def scenario_figures(
    missions: pd.DataFrame, traces: pd.DataFrame, styles: dict[str, style.Style]
) -> Iterator[tuple[str, str, str, Figure]]:
    """Yield name, title, caption and figure of each page: error and loss, on each track.

    Args:
        missions: from :func:`traced_missions`, those that have steps.
        traces: their steps.
        styles: how each method is drawn.
    """
    curves = steps_of(traces, missions["mission"])
    per_page = COLUMNS * ROWS
    for track, own in missions.groupby("track", sort=False):
        cells = list(own["cell"].unique())
        pages = [cells[k : k + per_page] for k in range(0, len(cells), per_page)]
        for column, label in LABELS.items():
            if not np.isfinite(traces[column]).any():
                continue
            for number, page in enumerate(pages, 1):
                rows = own[own["cell"].isin(page)]
                name, title = f"{column}_{track}", f"{TITLES[column]} on {track}"
                if len(pages) > 1:
                    name, title = f"{name}_{number}", f"{title}, page {number}"
                about = {"what": label[0].upper() + label[1:], "read": READ[column]}
                about |= {"track": track, "page": str(number), "pages": str(len(pages))}
                yield name, title, CAPTION.format(**about), _page(rows, curves, column, styles)


def _page(
    missions: pd.DataFrame,
    curves: dict[int, pd.DataFrame],
    column: str,
    styles: dict[str, style.Style],
) -> Figure:
    groups = list(missions.groupby("cell", sort=False))
    across = min(COLUMNS, len(groups))
    down = -(-len(groups) // across)
    figure = style.new_figure(max(2.9 * across, 5.5), 1.9 * down + 1.0)
    grid = figure.subplots(down, across, squeeze=False)
    for axes, (cell, rows) in zip(grid.flat, groups, strict=False):
        axes.set_xlim(0, last_step(rows))
        seed = rows["seed"].iloc[0]
        title = str(cell).partition(", ")[2] or str(cell)
        axes.set_title(style.literal(f"{title} (seed {seed})"), fontsize=style.SMALL, pad=8)
        steps = [curves[number] for number in rows["mission"]]
        for method, own in zip(rows["method"], steps, strict=True):
            draw_curve(axes, own, column, styles[method], many=True)
            mark_regime(axes, own, styles[method], False, lines=len(steps) <= FEW)
        scale_panel(axes, column, pd.concat(steps)[column])
        axes.grid(axis="y", color="#eeeeee", linewidth=0.6)
        style.dress(axes)
    for axes in grid.flat[len(groups) :]:
        axes.remove()
    _label(figure, grid, len(groups), column)
    used = [method for method in styles if (missions["method"] == method).any()]
    handles = [
        Line2D([], [], color=look.color, linestyle=look.linestyle, marker=look.marker, markersize=5)
        for look in (styles[method] for method in used)
    ]
    for marker in (STARTS, ENDS):
        handles.append(Line2D([], [], color=style.FAINT, marker=marker, linestyle="", markersize=6))
    style.legend_above(figure, handles, [*used, "changed regime starts", "ends"])
    return figure


def _label(figure: Figure, grid: np.ndarray, panels: int, column: str) -> None:
    across = grid.shape[1]
    lowest: list[Axes] = [grid.flat[k] for k in range(panels) if k + across >= panels]
    for axes in lowest:
        axes.set_xlabel("step", fontsize=style.SMALL)
    figure.supylabel(LABELS[column], fontsize=style.NORMAL)
