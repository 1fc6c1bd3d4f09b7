"""The line a robot has driven."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from afm_rl.report import style
from afm_rl.report.road import MARGIN, DrawableTrack, distance_to

THIN, THICK, BROAD = 1.1, 1.6, 8.0  # line widths (pt): nominal, changed, the band under it

NOMINAL: dict[str, Any] = {"color": style.NOMINAL, "linewidth": THIN}
CHANGED: dict[str, Any] = {"color": style.REGIME, "linewidth": THICK}
BAND: dict[str, Any] = {"color": style.BAND, "linewidth": BROAD, "alpha": 0.35}
POINT: dict[str, Any] = {"linestyle": "", "markeredgewidth": 1.0}
START = POINT | {"marker": "o", "color": "white", "markeredgecolor": "black", "markersize": 6}
FINISHED = POINT | {"marker": "o", "color": "#009e73", "markeredgecolor": "white", "markersize": 10}
TICK = POINT | {"marker": r"$\checkmark$", "color": "white", "markeredgewidth": 0, "markersize": 5}
GIVEN_UP = POINT | {"marker": "X", "color": "black", "markeredgecolor": "white", "markersize": 9}


def legend_handles() -> tuple[list[Any], list[str]]:
    """Return what the lines and markers of a path mean."""

    def line(**look: Any) -> Line2D:
        return Line2D([], [], **look)

    handles = [
        line(**NOMINAL),
        (line(**BAND), line(**CHANGED)),
        line(**START),
        (line(**FINISHED), line(**TICK)),
        line(**GIVEN_UP),
    ]
    return handles, ["nominal", "changed regime", "start", "finished", "given up"]


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
        finished: has it reached every target?
        track: to say how far from the road a mission that left the picture was given up.
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
    if finished:
        axes.plot(*end, **FINISHED, zorder=4, gid="finished")
        axes.plot(*end, **TICK, zorder=5)
        return
    axes.plot(*end, **GIVEN_UP, zorder=4, gid="given up")
    if track is not None and (end != whole[-1]).any():
        _say_where(axes, end, distance_to(track, whole[-1]))


def _last_inside(axes: Axes, path: np.ndarray) -> np.ndarray:
    """Return the last point of a path ``(T, 2)`` that is well inside the view."""
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    inset = MARGIN / 2 * (high - low).max()  # no end that the view was made for is farther out
    inside = ((path > low + inset) & (path < high - inset)).all(-1)
    return path[inside][-1] if inside.any() else (low + high) / 2


def _say_where(axes: Axes, end: np.ndarray, distance: float) -> None:
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
