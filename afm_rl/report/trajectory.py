"""Where the robot went: one small map per method and cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from afm_rl.report import style
from afm_rl.report.frames import first_missions, left_out, steps_of
from afm_rl.report.path import draw_path, legend_handles, positions
from afm_rl.report.road import Box, DrawableTrack, draw_road, view

PANELS = 12
WIDE, TALL, NARROW = 9.9, 3.4, 1.9  # inches: all maps side by side; one map: at most, at least
TITLES, ENDS, SIDE = 0.45, 0.75, 0.5  # inches: titles of a row; legend and footnote; labels


def draw_trajectories(
    missions: pd.DataFrame, steps: pd.DataFrame, tracks: Sequence[DrawableTrack] = ()
) -> Figure:
    """Return a figure of driven lines, methods side by side, cells below each other.

    Only the first seed is drawn, and at most 12 panels; the footnote says how much is left
    out. The stretch under the changed regime has another colour and a broad band under it.

    Args:
        missions: one row per mission.
        steps: one row per mission and step, with ``x`` and ``y`` (m).
        tracks: the tracks that the missions name; one that is not here is not drawn.
    """
    first = first_missions(missions)
    methods = list(first["method"].unique())[:PANELS]
    cells = list(first["cell"].unique())[: PANELS // len(methods)]
    shown = first[first["method"].isin(methods) & first["cell"].isin(cells)]
    paths, courses = steps_of(steps, shown["mission"]), {track.name: track for track in tracks}
    views = {
        cell: view(courses.get(rows["track"].iloc[0]), [positions(paths[m]) for m in rows.mission])
        for cell, rows in shown.groupby("cell")
    }
    figure, panels = _maps(methods, cells, views)
    for mission in shown.itertuples():
        axes, track = panels[mission.cell, mission.method], courses.get(mission.track)
        if track is not None:
            draw_road(axes, track)
        draw_path(axes, paths[mission.mission], bool(mission.finished), track)
        _title(axes, mission)
    title = style.literal(cells[0]) if len(cells) == 1 else None
    style.legend_above(figure, *legend_handles(), title)
    style.footnote(figure, left_out(missions, shown))
    return figure


def _maps(
    methods: Sequence[str], cells: Sequence[str], views: Mapping[str, Box]
) -> tuple[Figure, dict[tuple[str, str], Axes]]:
    """Return a figure with axes by cell and method; those of a row show the same area."""
    width = max(NARROW, min(WIDE / len(methods), 1.5 * TALL))
    ratios = [
        (views[cell].top - views[cell].bottom) / (views[cell].right - views[cell].left)
        for cell in cells
    ]
    tall = [min(width * ratio, TALL) for ratio in ratios]
    height = sum(tall) + TITLES * len(cells) + ENDS
    figure = style.new_figure(max(width * len(methods) + SIDE, 5.0), height)
    grid = figure.add_gridspec(len(cells), len(methods), height_ratios=tall)
    panels = {}
    for row, cell in enumerate(cells):
        box, last = views[cell], row == len(cells) - 1
        for column, method in enumerate(methods):
            axes = figure.add_subplot(grid[row, column], aspect="equal")
            axes.set(xlim=(box.left, box.right), ylim=(box.bottom, box.top))
            style.dress(axes)
            axes.xaxis.set_major_locator(MaxNLocator(4))
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.tick_params(labelleft=column == 0)
            if last:
                axes.set_xlabel("x (m)", fontsize=style.SMALL)
            if column == 0:
                head = style.literal(cell).replace(", ", "\n") + "\n" if len(cells) > 1 else ""
                axes.set_ylabel(f"{head}y (m)", fontsize=style.SMALL)
            panels[cell, method] = axes
    return figure, panels


def _title(axes: Axes, mission: Any) -> None:
    """Write the method and how it fared above its map."""
    axes.set_title(style.literal(mission.method) + "\n", fontsize=style.LARGE, weight="bold")
    axes.annotate(
        f"{mission.reached}/{mission.targets} targets, {mission.steps} steps",
        (0.5, 1.0),
        (0, 5),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=style.SMALL,
    )
