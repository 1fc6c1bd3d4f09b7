"""Where robots went on the ground: one small map per method and scenario."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox

from afm_rl.errors import ConfigurationError
from afm_rl.report import style
from afm_rl.report.runs import outcome, steps_of
from afm_rl.report.style import ROAD
from afm_rl.storage.measures import Measures


class DrawableTrack(Protocol):
    """What a figure must know of a track; lengths in metres."""

    @property
    def name(self) -> str:
        """Name in the tables."""

    @property
    def waypoints(self) -> Any:
        """Points to reach, ``(W, 2)``."""

    @property
    def centerline(self) -> Any:
        """Dense closed line, ``(M, 2)``."""

    @property
    def width(self) -> float:
        """Width of the road."""


def load_tracks(
    names: Iterable[str], load_track: Callable[[str], DrawableTrack]
) -> list[DrawableTrack]:
    """Return the tracks that can be loaded by name; others are drawn without a road."""
    tracks = []
    for name in names:
        with suppress(ConfigurationError):
            tracks.append(load_track(str(name)))
    return tracks


def draw_road(axes: Axes, track: DrawableTrack) -> None:
    """Draw the road as a ribbon, with its waypoints.

    The ribbon is a row of discs: it is as wide as the track says whatever the size of the axes, and
    sharp corners come out right.
    """
    middle = np.asarray(track.centerline, dtype=float)
    size = np.full(len(middle), float(track.width))
    discs = EllipseCollection(
        size, size, np.zeros(len(middle)), units="xy", offsets=middle, facecolors=ROAD, linewidths=0
    )
    discs.set(offset_transform=axes.transData, gid="road", zorder=0.5)
    axes.add_collection(discs)
    x, y = np.asarray(track.waypoints, dtype=float).T
    axes.plot(x, y, ".", color="#9a9a9a", markersize=3.5, zorder=1, gid="waypoints")


def view(
    track: DrawableTrack | None,
    paths: Sequence[np.ndarray],
    margin: float = 0.04,
    stray: float = 0.15,
) -> Bbox:
    """Return the area to show of a track and paths ``(N, 2)``.

    Paths that leave the road are followed a little way only: a robot that has gone astray
    must not shrink the road to a dot.
    """
    points = np.concatenate([path[np.isfinite(path).all(-1)] for path in paths])
    if track is None:
        edge, stray = points, 0.0
    else:
        line, half = np.asarray(track.centerline, dtype=float), track.width / 2
        edge = np.concatenate([line - half, line + half])
    low, high = (edge.min(0), edge.max(0)) if len(edge) else (np.zeros(2), np.ones(2))
    span = np.maximum(high - low, 1e-3)
    if len(points):
        low = np.minimum(low, np.maximum(points.min(0), low - stray * span))
        high = np.maximum(high, np.minimum(points.max(0), high + stray * span))
    around = margin * span.max()
    return Bbox([low - around, high + around])


def draw_trajectories(
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack] = (),
    panels: int = 24,
) -> Figure:
    """Return a figure of driven lines, methods side by side, scenarios below each other.

    Only the first seed is drawn, and 6 methods at most; the footnote names the
    rest. The stretch under the changed regime has another colour and a broad band under it.

    Args:
        missions: one row per mission.
        steps: one row per mission and step, with ``x`` and ``y`` (m).
        measures: measures whose values are above each map.
        tracks: the tracks of the missions; a missing track is not drawn.
        panels: largest number of maps.
    """
    count = min(missions["method"].nunique(), style.FEW)
    shown, styles, left_out = style.excerpt(missions, panels // count)
    paths, roads = steps_of(steps, shown["mission"]), {track.name: track for track in tracks}
    views = {
        scenario: view(
            roads.get(rows["track"].iloc[0]), [positions(paths[m]) for m in rows.mission]
        )
        for scenario, rows in shown.groupby("scenario", sort=False)
    }
    figure, maps = _maps(list(styles), views)
    for mission in shown.to_dict("records"):
        axes, track = maps[mission["scenario"], mission["method"]], roads.get(mission["track"])
        if track is not None:
            draw_road(axes, track)
        ended = outcome(mission)
        finished = bool(mission[ended]) == (ended == "finished")
        draw_path(axes, paths[mission["mission"]], finished)
        _title(axes, mission, measures)
    looks = {
        "nominal": [style.BEFORE],
        "changed regime": [style.BROAD, style.CHANGED],
        "start": [style.START],
        "finished": [style.FINISHED, style.TICK],
        "not finished": [style.GIVEN_UP],
    }
    handles = [tuple(Line2D([], [], **look) for look in each) for each in looks.values()]
    style.legend_above(figure, handles, list(looks), next(iter(views)) if len(views) == 1 else None)
    style.footnote(figure, left_out)
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


def draw_path(axes: Axes, steps: pd.DataFrame, finished: bool) -> None:
    """Draw one mission: its line, the changed stretch, the start and how it ended."""
    path = positions(steps)
    changed = changed_stretch(steps["regime_active"].to_numpy())
    x, y = np.where(changed[:, None], path, np.nan).T
    axes.plot(x, y, **style.BROAD, solid_capstyle="round", zorder=1.5, gid="band")
    axes.plot(*path.T, **style.BEFORE, zorder=2, gid="nominal")
    axes.plot(x, y, **style.CHANGED, zorder=2.5, gid="changed")
    driven = path[np.isfinite(path).all(-1)]
    if not len(driven):
        return
    axes.plot(*driven[:1].T, **style.START, zorder=4, gid="start")
    end, look = _last_inside(axes, driven), style.FINISHED if finished else style.GIVEN_UP
    axes.plot(*end, **look, zorder=4, gid="finished" if finished else "given up")
    if finished:
        axes.plot(*end, **style.TICK, zorder=5)


def _last_inside(axes: Axes, path: np.ndarray, inset: float = 0.02) -> np.ndarray:
    """Return the last point of a path ``(T, 2)`` that is well inside the view."""
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    edge = inset * (high - low).max()
    inside = ((path > low + edge) & (path < high - edge)).all(-1)
    return path[inside][-1] if inside.any() else (low + high) / 2


def _maps(
    methods: Sequence[str], views: Mapping[str, Bbox]
) -> tuple[Figure, dict[tuple[str, str], Axes]]:
    """Return a figure with axes by scenario and method; those of a row show the same area."""
    tallest = 3.4
    width = max(1.9, min(9.9 / len(methods), 1.5 * tallest))
    tall = [min(width * box.height / box.width, tallest) for box in views.values()]
    height = sum(tall) + 0.5 * len(views) + 0.95  # titles of the rows; legend and footnote
    figure = style.new_figure(max(width * len(methods) + 0.5, 5.0), height)
    grid = figure.add_gridspec(len(views), len(methods), height_ratios=tall)
    maps = {}
    for row, (scenario, box) in enumerate(views.items()):
        head = scenario.replace(", ", "\n") + "\n" if len(views) > 1 else ""
        for column, method in enumerate(methods):
            axes = figure.add_subplot(grid[row, column], aspect="equal")
            axes.set(xlim=box.intervalx, ylim=box.intervaly)
            below = "x (m)" if row == len(views) - 1 else ""
            style.dress(axes, below, "" if column else f"{head}y (m)")
            axes.xaxis.set_major_locator(MaxNLocator(4))
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.tick_params(labelleft=column == 0)
            maps[scenario, method] = axes
    return figure, maps


def _title(axes: Axes, mission: Mapping[str, Any], measures: Measures) -> None:
    """Write the method and its headline measures above its map."""
    values = (
        f"{m.text(mission[m.column], 0 if m.scale > 1 else m.digits)} {m.unit or m.name}"
        for m in measures.headlines
    )
    title = f"{style.literal(mission['method'])}\n{', '.join(values)}"
    axes.set_title(title, fontsize=style.NORMAL)
