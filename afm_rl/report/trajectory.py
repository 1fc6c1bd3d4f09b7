"""Where the robot went: one small map per method and cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from afm_rl.report import style
from afm_rl.report.frames import first_missions, left_out, outcome, steps_of
from afm_rl.report.track_plot import MARGIN, Box, DrawableTrack, distance_to, draw_road, view
from afm_rl.storage.measures import Measures

PANELS = 12
WIDE, TALL, NARROW = 9.9, 3.4, 1.9  # inches: all maps side by side; one map: at most, at least
TITLES, ENDS, SIDE = 0.5, 0.95, 0.5  # inches: titles of a row; legend and footnote; labels

NOMINAL: dict[str, Any] = {"color": style.NOMINAL, "linewidth": 1.1}
CHANGED: dict[str, Any] = {"color": style.REGIME, "linewidth": 1.6}
BAND: dict[str, Any] = {"color": style.BAND, "linewidth": 8.0, "alpha": 0.35}
POINT: dict[str, Any] = {"linestyle": "", "markeredgewidth": 1.0}
START = POINT | {"marker": "o", "color": "white", "markeredgecolor": "black", "markersize": 6}
FINISHED = POINT | {"marker": "o", "color": "#009e73", "markeredgecolor": "white", "markersize": 10}
TICK = POINT | {"marker": r"$\checkmark$", "color": "white", "markeredgewidth": 0, "markersize": 5}
GIVEN_UP = POINT | {"marker": "X", "color": "black", "markeredgecolor": "white", "markersize": 9}


def draw_trajectories(
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack] = (),
) -> Figure:
    """Return a figure of driven lines, methods side by side, cells below each other.

    Only the first seed is drawn, and at most 12 panels of 6 methods; the footnote says how much is
    left out. The stretch under the changed regime has another colour and a broad band under it.

    Args:
        missions: one row per mission.
        steps: one row per mission and step, with ``x`` and ``y`` (m).
        measures: those whose values stand above each map, the headlines.
        tracks: the tracks that the missions name; one that is not here is not drawn.
    """
    first = first_missions(missions)
    methods = list(first["method"].unique())[: style.FEW]
    cells = list(first["cell"].unique())[: PANELS // len(methods)]
    shown = first[first["method"].isin(methods) & first["cell"].isin(cells)]
    paths, known = steps_of(steps, shown["mission"]), {track.name: track for track in tracks}
    views = {
        cell: view(known.get(rows["track"].iloc[0]), [positions(paths[m]) for m in rows.mission])
        for cell, rows in shown.groupby("cell")
    }
    figure, panels = _maps(methods, cells, views)
    for mission in shown.to_dict("records"):
        axes = panels[mission["cell"], mission["method"]]
        track = known.get(mission["track"])
        if track is not None:
            draw_road(axes, track)
        ended = outcome(mission)
        finished = bool(mission[ended]) == (ended == "finished")
        draw_path(axes, paths[mission["mission"]], finished, track)
        _title(axes, mission, measures)
    title = style.literal(cells[0]) if len(cells) == 1 else None
    style.legend_above(figure, *_legend(), title)
    style.footnote(figure, left_out(missions, shown))
    return figure


def positions(steps: pd.DataFrame) -> np.ndarray:
    """Return where a mission went (m), ``(T, 2)``."""
    return steps[["x", "y"]].to_numpy(dtype=float)


def changed_stretch(active: np.ndarray) -> np.ndarray:
    """Return which points ``(T,)`` belong to moves made under the changed regime.

    Step ``t`` leads from point ``t`` to the next one, so both belong to it.

    >>> changed_stretch(np.array([0, 1, 0, 0])).tolist()
    [False, True, True, False]
    """
    moved = np.asarray(active, dtype=bool)
    return moved | np.concatenate([[False], moved[:-1]])


def draw_path(
    axes: Axes, steps: pd.DataFrame, finished: bool, track: DrawableTrack | None = None
) -> None:
    """Draw one mission: its line, the changed stretch, the start and how it ended.

    Args:
        axes: where to; their limits must be set.
        steps: the mission's steps, in order.
        finished: did it finish?
        track: to say how far from the road a mission that left the picture ended.
    """
    path = positions(steps)
    changed = changed_stretch(steps["regime_active"].to_numpy())
    x, y = np.where(changed[:, None], path, np.nan).T
    axes.plot(x, y, **BAND, solid_capstyle="round", zorder=1.5, gid="band")
    axes.plot(*path.T, **NOMINAL, zorder=2, gid="nominal")
    axes.plot(x, y, **CHANGED, zorder=2.5, gid="changed")
    whole = path[np.isfinite(path).all(-1)]
    if not len(whole):
        return
    axes.plot(*whole[:1].T, **START, zorder=4, gid="start")
    end = _last_inside(axes, whole)
    axes.plot(*end, **(FINISHED if finished else GIVEN_UP), zorder=4)
    axes.lines[-1].set_gid("finished" if finished else "given up")
    if finished:
        axes.plot(*end, **TICK, zorder=5)
    elif track is not None and (end != whole[-1]).any():
        _write_distance(axes, end, distance_to(track, whole[-1]))


def _last_inside(axes: Axes, path: np.ndarray) -> np.ndarray:
    """Return the last point of a path ``(T, 2)`` that is well inside the view."""
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    inset = MARGIN / 2 * (high - low).max()  # no end that the view was made for is farther out
    inside = ((path > low + inset) & (path < high - inset)).all(-1)
    return path[inside][-1] if inside.any() else (low + high) / 2


def _write_distance(axes: Axes, end: np.ndarray, distance: float) -> None:
    """Write beside the mark of an end how far away the true one is, clear of the line."""
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    right, up = place = 2 * (end - low) / (high - low) - 1  # -1 to 1, edge to edge
    sideways = abs(right) > abs(up)  # how the line leaves
    axes.annotate(
        f"ends {distance:.0f} m away",
        tuple(end),
        tuple(-np.sign(place) * ((0, 12) if sideways else (8, 0))),
        textcoords="offset points",
        ha="right" if right > 0 else "left",
        va="center",
        fontsize=style.SMALL,
        path_effects=[withStroke(linewidth=2, foreground="white")],
        zorder=6,
    )


def _legend() -> tuple[list[Any], list[str]]:
    """Return what the lines and markers of a path mean."""
    looks = ((NOMINAL,), (BAND, CHANGED), (START,), (FINISHED, TICK), (GIVEN_UP,))
    handles = [tuple(Line2D([], [], **look) for look in each) for each in looks]
    return handles, ["nominal", "changed regime", "start", "finished", "not finished"]


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


def _title(axes: Axes, mission: Mapping[str, Any], measures: Measures) -> None:
    """Write the method and its headline measures above its map."""
    axes.set_title(style.literal(mission["method"]) + "\n", fontsize=style.LARGE, weight="bold")
    texts = [
        f"{m.text(mission[m.column], 0 if m.scale > 1 else m.digits)} {m.unit or m.name}"
        for m in measures.headlines
    ]
    axes.annotate(
        ", ".join(texts),
        (0.5, 1.0),
        (0, 5),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=style.SMALL,
    )
