"""What a film of one mission shows: a figure, and how it looks at a step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Polygon

from afm_rl.report import style
from afm_rl.report.flight import REFERENCE, dress_space, mark_regimes
from afm_rl.report.path import CHANGED, NOMINAL, START, changed_stretch, positions
from afm_rl.report.road import DrawableTrack, draw_road, view

DRIVE_COLUMNS = (
    *("x", "y", "theta", "goal_x", "goal_y", "planned_v", "planned_omega", "executed_v"),
    *("executed_omega", "error", "misaligned", "regime_active"),
)
FLIGHT_COLUMNS = (
    *("x", "y", "z", "goal_x", "goal_y", "goal_z", "planned_thrust", "executed_thrust"),
    *("misaligned", "regime_active", "phase"),
)
PLANNED: dict[str, Any] = {"color": "#0072b2"}
EXECUTED: dict[str, Any] = {"color": "#cc79a7"}
GOAL: dict[str, Any] = {"marker": "*", "color": "#009e73", "markersize": 13, "linestyle": ""}
BODY = np.array([[1.0, 0.0], [-0.8, 0.65], [-0.4, 0.0], [-0.8, -0.65]])  # seen from above
SIZE, REACH = 0.022, 0.13  # robot and longest arrow, as parts of the map
GRID = 0.16  # inches: sides of pictures are multiples of 16 pixels, as video codecs want them
AHEAD = 0.5  # s, how long arrows turn
LEAST = 1e-6  # smallest error that is told apart from none


class Scene(NamedTuple):
    """A figure whose moving parts can be set to any step."""

    figure: Figure
    moving: Sequence[Artist]
    """All that differs from frame to frame."""
    show: Callable[[int], None]
    """Sets the moving parts to a row of the table of steps."""


def drive_scene(title: str, steps: pd.DataFrame, track: DrawableTrack | None = None) -> Scene:
    """Return the scene of a drive: a map, and the error over time under it.

    Arrows show the planned action (wide) and the executed one (slim): as long as the robot is
    to be fast, and turned by how far it is to turn in half a second.

    Args:
        title: what is shown.
        steps: one mission's steps, with :data:`DRIVE_COLUMNS`. If there is a ``miss``, it is
            drawn in place of ``error``.
        track: the road.
    """
    path = positions(steps)
    box = view(track, [path])
    tall = 5.6 * np.clip((box.top - box.bottom) / (box.right - box.left), 0.4, 1.2)
    figure = style.new_figure(6.4, GRID * round((tall + 2.3) / GRID))
    upper, lower = figure.subplots(2, 1, height_ratios=[tall, 1.1])
    upper.set(xlim=(box.left, box.right), ylim=(box.bottom, box.top), aspect="equal")
    upper.set(xlabel="x (m)", ylabel="y (m)")
    style.dress(upper)
    if track is not None:
        draw_road(upper, track)
    upper.plot(*path[:1].T, **START, zorder=3)

    name, label = ("error", "error of the\nmodel (m, rad)")
    if "miss" in steps and steps["miss"].notna().all():
        name, label = ("miss", "distance from\nthe plan (m)")
    lower.plot(steps["t"], steps[name].clip(lower=LEAST), color=style.NOMINAL, linewidth=0.9)
    lower.set(yscale="log", ylabel=label)
    cursors = _timeline([lower], steps)

    (before,) = upper.plot([], [], **NOMINAL, zorder=4)
    (under,) = upper.plot([], [], **CHANGED, zorder=4)
    (goal,) = upper.plot([], [], **GOAL, zorder=5)
    arrows = [_arrow(upper, PLANNED, 6.0), _arrow(upper, EXECUTED, 2.5)]
    robot = Polygon(BODY, facecolor=style.NOMINAL, edgecolor="white", linewidth=0.8, zorder=7)
    upper.add_patch(robot)
    said = _speech(upper)
    handles = [before, under, goal, Line2D([], [], linewidth=6.0, **PLANNED)]
    handles.append(Line2D([], [], linewidth=2.5, **EXECUTED))
    labels = ["nominal", "changed regime", "target", "planned action", "executed action"]
    style.legend_above(figure, handles, labels, style.literal(title))

    changed = np.where(changed_stretch(steps["regime_active"].to_numpy())[:, None], path, np.nan)
    span = max(box.right - box.left, box.top - box.bottom)
    goals, heading = steps[["goal_x", "goal_y"]].to_numpy(), steps["theta"].to_numpy(dtype=float)
    courses = _courses(steps, heading) * REACH * span

    def show(row: int) -> None:
        here = path[row]
        before.set_data(*path[: row + 1].T)
        under.set_data(*changed[: row + 1].T)
        goal.set_data(*goals[row : row + 1].T)
        for arrow, course in zip(arrows, courses, strict=True):
            arrow.set_positions(here, here + course[row])
        cos, sin = np.cos(heading[row]), np.sin(heading[row])
        robot.set_xy(here + SIZE * span * BODY @ np.array([[cos, sin], [-sin, cos]]))
        _tell(steps.iloc[row], cursors, said)

    return Scene(figure, [before, under, goal, *arrows, robot, *cursors, said], show)


def flight_scene(title: str, steps: pd.DataFrame) -> Scene:
    """Return the scene of a flight: the path so far, and height and thrust over time.

    Args:
        title: what is shown.
        steps: one mission's steps, with :data:`FLIGHT_COLUMNS`.
    """
    figure = style.new_figure(9.6, 28 * GRID)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.2, 1])
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    height, thrust = (figure.add_subplot(grid[row, 1]) for row in (0, 1))
    flown = steps[["x", "y", "z"]].to_numpy(dtype=float)
    space.plot(*steps[["goal_x", "goal_y", "goal_z"]].to_numpy().T, **REFERENCE)
    space.plot(*flown.T, alpha=0.0)  # so that the axes have room for all of it
    dress_space(space)

    height.plot(steps["t"], steps["goal_z"], **REFERENCE)
    height.plot(steps["t"], steps["z"], color=style.NOMINAL, linewidth=1.2)
    height.set(ylabel="height (m)")
    thrust.plot(steps["t"], steps["planned_thrust"], linewidth=3.0, **PLANNED)
    thrust.plot(steps["t"], steps["executed_thrust"], linewidth=1.2, **EXECUTED)
    thrust.set(ylabel="thrust (N)")
    cursors = _timeline([height, thrust], steps)

    (path,) = space.plot([], [], [], color=style.NOMINAL, linewidth=1.4)
    (robot,) = space.plot([], [], [], "o", color=style.REGIME, markersize=7)
    (goal,) = space.plot([], [], [], **GOAL)
    said = _speech(space)
    wanted = steps[["goal_x", "goal_y", "goal_z"]].to_numpy(dtype=float)
    handles = [Line2D([], [], **REFERENCE), path, robot, goal]
    handles += [Line2D([], [], linewidth=3.0, **PLANNED), Line2D([], [], linewidth=1.2, **EXECUTED)]
    labels = ["reference", "flown", "now", "set-point", "planned thrust", "executed thrust"]
    style.legend_above(figure, handles, labels, style.literal(title))

    def show(row: int) -> None:
        path.set_data_3d(*flown[: row + 1].T)
        robot.set_data_3d(*flown[row : row + 1].T)
        goal.set_data_3d(*wanted[row : row + 1].T)
        _tell(steps.iloc[row], cursors, said)

    return Scene(figure, [path, goal, robot, *cursors, said], show)


def _courses(steps: pd.DataFrame, heading: np.ndarray) -> np.ndarray:
    """Return arrows ``(2, T, 2)`` of planned and executed actions, the longest of size 1."""
    kinds = ("planned", "executed")
    fast, turning = (
        np.stack([steps[f"{kind}_{name}"].to_numpy(dtype=float) for kind in kinds])
        for name in ("v", "omega")
    )
    angle = heading + AHEAD * turning
    longest = max(float(np.nanmax(np.abs(fast))), LEAST)
    return np.stack([np.cos(angle), np.sin(angle)], -1) * (fast / longest)[..., None]


def _arrow(axes: Axes, look: dict[str, Any], width: float) -> FancyArrowPatch:
    whole: dict[str, Any] = {"shrinkA": 0, "shrinkB": 0, "linewidth": width, "zorder": 6}
    head: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 9 + width}
    arrow = FancyArrowPatch((0, 0), (0, 0), **whole, **head, **look)
    axes.add_patch(arrow)
    return arrow


def _timeline(panels: Sequence[Axes], steps: pd.DataFrame) -> list[Line2D]:
    """Dress axes over time, shade the changed regime; return the lines that mark now."""
    mark_regimes(panels, steps)
    for axes in panels:
        style.dress(axes)
        axes.set_xlim(0, max(int(steps["t"].iloc[-1]), 1))
    panels[-1].set_xlabel("step")
    return [axes.axvline(0, color=style.REGIME, linewidth=1.2) for axes in panels]


def _speech(axes: Any) -> Any:
    """Return an empty line above axes."""
    speak = axes.text2D if hasattr(axes, "text2D") else axes.text
    return speak(0.0, 1.01, "", transform=axes.transAxes, fontsize=style.NORMAL)


def _tell(step: Any, cursors: Sequence[Line2D], said: Any) -> None:
    """Move the cursors and say what is the case."""
    for cursor in cursors:
        cursor.set_xdata([step["t"], step["t"]])
    regime = "changed regime" if step["regime_active"] else "nominal"
    seen = ", misaligned" if step["misaligned"] else ""
    said.set_text(f"step {int(step['t'])}: {regime}{seen}")
