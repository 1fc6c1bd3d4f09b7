"""Where robots spent their time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure

from afm_rl.report import style
from afm_rl.report.track_plot import DrawableTrack, draw_road, view

CAPTION = (
    "Where robots were on {track}: all seeds of a method (rows) under a regime (columns), the "
    "number of steps spent in each square of 0.4 m, on one logarithmic scale, over the "
    "road. Dark spots are places where a robot stayed for long. A robot that leaves the road is "
    "followed a little way only."
)
Places = Mapping[tuple[str, str], np.ndarray]


def draw_heatmaps(
    places: Places, track: DrawableTrack | None = None, square: float = 0.4
) -> Iterator[Figure]:
    """Yield figures with maps of at most six methods each, all on one scale.

    Args:
        places: where robots were (m), ``(N, 2)``, by cell and method.
        track: the road.
        square: side of the squares in which steps are counted (m).
    """
    box, cells = view(track, list(places.values())), list(dict.fromkeys(cell for cell, _ in places))
    edges = [np.arange(low, high + square, square) for low, high in (box[:2], box[2:])]
    counts = {key: np.histogramdd(points, edges)[0] for key, points in places.items()}
    scale = LogNorm(1, max(2.0, *(count.max() for count in counts.values())))
    # From light to dark in greyscale, too; without the palest, which the road would swallow.
    colours = ListedColormap(colormaps["magma_r"](np.linspace(0.25, 1.0, 256)))
    for methods in style.groups_of_methods(method for _, method in places):
        width, height = 2.1 * len(cells) + 1.4, min(0.9 * 2.1 * box.ratio, 2.6) + 0.1
        figure = style.new_figure(width, height * len(methods) + 0.9)
        grid = figure.subplots(len(methods), len(cells), squeeze=False, sharex=True, sharey=True)
        for row, method in zip(grid, methods, strict=True):
            for axes, cell in zip(row, cells, strict=True):
                axes.set(xlim=box[:2], ylim=box[2:], aspect="equal")
                if track is not None:
                    draw_road(axes, track)
                if (cell, method) in counts:
                    count = np.ma.masked_equal(counts[cell, method].T, 0)
                    axes.pcolormesh(*edges, count, cmap=colours, norm=scale)
                else:
                    axes.text(0.5, 0.5, "missing", transform=axes.transAxes, ha="center", zorder=5)
                beside = method + "\ny (m)" if axes is row[0] else ""
                style.dress(axes, "x (m)" if axes in grid[-1] else "", beside)
        for axes, cell in zip(grid[0], cells, strict=True):
            title = style.literal((cell.partition(", ")[2] or cell).replace(", ", "\n"))
            axes.set_title(title, fontsize=style.SMALL)
        bar = figure.colorbar(ScalarMappable(scale, colours), ax=grid, fraction=0.03, pad=0.01)
        bar.set_label("steps in a square", fontsize=style.SMALL)
        bar.ax.tick_params(labelsize=style.SMALL)
        yield figure
