"""Where robots spent their time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure

from afm_rl.report import style
from afm_rl.report.track_plot import Box, DrawableTrack, draw_road, view

WIDE, TALL = 2.1, 2.6  # inches: a map at most
SQUARE = 0.4  # m: a histogram's bin
# From light to dark in greyscale, too; without the palest, which the road would swallow.
COLOURS = ListedColormap(colormaps["magma_r"](np.linspace(0.25, 1.0, 256)))
CAPTION = (
    "Where robots were on {track}: all seeds of a method (rows) under a regime (columns), the "
    f"number of steps spent in each square of {SQUARE:g} m, on one logarithmic scale, over the "
    "road. Dark spots are places where a robot stayed for long. A robot that leaves the road is "
    "followed a little way only."
)
Places = Mapping[tuple[str, str], np.ndarray]


def draw_heatmaps(places: Places, track: DrawableTrack | None = None) -> Iterator[Figure]:
    """Yield figures with maps of at most six methods each, all on one scale.

    Args:
        places: where robots were (m), ``(N, 2)``, by cell and method.
        track: the road.
    """
    counted = _count(track, places)
    cells = list(dict.fromkeys(cell for cell, _ in places))
    for methods in style.groups_of_methods(method for _, method in places):
        yield _page(cells, methods, counted)


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
                axes.text(0.5, 0.5, "missing", transform=axes.transAxes, ha="center", zorder=5)
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
