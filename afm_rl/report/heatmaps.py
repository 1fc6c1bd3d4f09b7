"""Where robots spent their time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure

from afm_rl.report import style
from afm_rl.report.road import Box, DrawableTrack, draw_road, view

CELLS, METHODS = 4, 6  # across and down a page
WIDE, TALL = 2.1, 2.6  # inches: a map at most
SQUARE = 0.4  # m: a histogram's bin
# From light to dark in greyscale, too; without the palest, which the road would swallow.
COLOURS = ListedColormap(colormaps["magma_r"](np.linspace(0.25, 1.0, 256)))
CAPTION = (
    "Where robots were on {track}: all seeds of a method (rows) under a regime (columns), the "
    "number of steps spent in each square of {square:g} m, on one logarithmic scale, over the "
    "road (page {page} of {pages}). Dark spots are places where a robot hung about. Shown are the "
    "regimes in which the methods' success differs most. A robot that strays is followed a little "
    "way only."
)
Places = Mapping[tuple[str, str], np.ndarray]


def mapped_cells(missions: pd.DataFrame) -> list[str]:
    """Return the cells to draw: on each track those in which methods differ most.

    >>> rows = {"track": ["oval"] * 2, "method": ["a", "b"], "cell": ["oval, c"] * 2}
    >>> mapped_cells(pd.DataFrame(rows | {"success_rate": [0.5, 1.0]}))
    ['oval, c']
    """
    means = missions.groupby(["track", "cell", "method"], sort=False)["success_rate"].mean()
    spread = means.groupby(["track", "cell"], sort=False).std().fillna(0.0)
    chosen = spread.sort_values(ascending=False, kind="stable").groupby("track").head(CELLS)
    return [cell for _, cell in spread.index if (_, cell) in chosen.index]


def heat_figures(
    missions: pd.DataFrame, places: Places, tracks: Sequence[DrawableTrack]
) -> Iterator[tuple[str, str, str, Figure]]:
    """Yield name, title, caption and figure of each page of maps.

    Args:
        missions: one row per mission, with ``cell``.
        places: where robots were (m), ``(N, 2)``, by cell and method.
        tracks: tracks to draw, found by name.
    """
    known = {track.name: track for track in tracks}
    mapped = {cell for cell, _ in places}
    for track, own in missions[missions["cell"].isin(mapped)].groupby("track", sort=False):
        cells = [cell for cell in own["cell"].unique() if cell in mapped]
        there = {
            key: places[key] for key in product(cells, own["method"].unique()) if key in places
        }
        counted = _count(known.get(track), there)
        methods = [
            method for method in own["method"].unique() if any(m == method for _, m in there)
        ]
        pages = np.array_split(methods, -(-len(methods) // METHODS))
        for number, page in enumerate(pages, 1):
            name, title = f"heat_{track}", f"Places on {track}"
            if len(pages) > 1:
                name, title = f"{name}_{number}", f"{title}, page {number}"
            about = {"track": track, "square": SQUARE, "page": number, "pages": len(pages)}
            yield name, title, CAPTION.format(**about), _page(cells, list(page), counted)


class _Counted(NamedTuple):
    """Steps spent in each square of a track."""

    track: DrawableTrack | None
    box: Box
    edges: list[np.ndarray]
    counts: dict[tuple[str, str], np.ndarray]
    most: float


def _count(track: DrawableTrack | None, places: Places) -> _Counted:
    box = view(track, list(places.values()))
    edges = [np.arange(low, high + SQUARE, SQUARE) for low, high in (box[:2], box[2:])]
    counts = {key: np.histogramdd(points, edges)[0] for key, points in places.items()}
    return _Counted(track, box, edges, counts, max(2.0, *(c.max() for c in counts.values())))


def _page(cells: Sequence[str], methods: Sequence[str], counted: _Counted) -> Figure:
    track, box, edges, counts, most = counted
    ratio = (box.top - box.bottom) / (box.right - box.left)
    width, height = WIDE * len(cells) + 1.4, min(0.9 * WIDE * ratio, TALL) + 0.1
    figure = style.new_figure(width, height * len(methods) + 0.9)
    grid = figure.subplots(len(methods), len(cells), squeeze=False, sharex=True, sharey=True)
    scale = LogNorm(1, most)
    for row, method in zip(grid, methods, strict=True):
        for axes, cell in zip(row, cells, strict=True):
            axes.set(xlim=box[:2], ylim=box[2:], aspect="equal")
            if track is not None:
                draw_road(axes, track)
            if (cell, method) in counts:
                count = np.ma.masked_equal(counts[cell, method].T, 0)
                axes.pcolormesh(*edges, count, cmap=COLOURS, norm=scale)
            else:
                _say_missing(axes)
            style.dress(axes)
        row[0].set_ylabel(style.literal(method) + "\ny (m)", fontsize=style.SMALL)
    for axes, cell in zip(grid[0], cells, strict=True):
        title = style.literal((cell.partition(", ")[2] or cell).replace(", ", "\n"))
        axes.set_title(title, fontsize=style.SMALL)
    for axes in grid[-1]:
        axes.set_xlabel("x (m)", fontsize=style.SMALL)
    bar = figure.colorbar(ScalarMappable(scale, COLOURS), ax=grid, fraction=0.03, pad=0.01)
    bar.set_label("steps in a square", fontsize=style.SMALL)
    bar.ax.tick_params(labelsize=style.SMALL)
    return figure


def _say_missing(axes: Axes) -> None:
    axes.text(
        0.5, 0.5, "missing", transform=axes.transAxes, ha="center", fontsize=style.SMALL, zorder=5
    )
