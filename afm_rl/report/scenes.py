"""What a film shows: a figure, and how it looks at a step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Polygon

from afm_rl.report import style
from afm_rl.report.cells import action_names
from afm_rl.report.space_plot import GOAL, POSITION, dress_space, mark_regimes
from afm_rl.report.style import BEFORE, CHANGED, EXECUTED, PLANNED, REFERENCE, START, TARGET
from afm_rl.report.track_plot import DrawableTrack, draw_road, view
from afm_rl.report.trajectory import changed_stretch, positions

COLUMNS = ("x", "y", "goal_x", "goal_y", "error", "misaligned", "regime_active")  # at least
BODY = np.array([[1.0, 0.0], [-0.8, 0.65], [-0.4, 0.0], [-0.8, -0.65]])  # seen from above
GRID = 0.16  # inches: sides of pictures are multiples of 16 pixels, as video codecs want them
LEAST = 1e-6  # smallest distance that is told apart from none


class Scene(NamedTuple):
    """A figure whose moving parts can be set to any step."""

    figure: Figure
    moving: Sequence[Artist]
    """All that differs from frame to frame."""
    show: Callable[[int], None]
    """Sets the moving parts to a row of the table of steps, or of the longest of several."""


def map_scene(
    title: str, runs: Mapping[str, pd.DataFrame], track: DrawableTrack | None = None
) -> Scene:
    """Return the scene of robots on a map, and their distance from the plan over time under it.

    A robot alone has its target, and arrows for the planned action (wide) and the executed one
    (slim), if its actions are called ``v`` and ``omega``: as long as the robot is to be fast, and
    turned by how far it is to turn in half a second. Several robots move at the same time.

    Args:
        title: what is shown.
        runs: each method's steps, with :data:`COLUMNS`; ``miss`` is drawn if all have it, and
            ``error`` otherwise.
        track: the road.
    """
    paths = {method: positions(steps) for method, steps in runs.items()}
    box = view(track, list(paths.values()))
    tall = 5.6 * np.clip(box.ratio, 0.4, 1.2)
    figure = style.new_figure(6.4, GRID * round((tall + 2.3) / GRID))
    upper, lower = figure.subplots(2, 1, height_ratios=[tall, 1.1])
    upper.set(xlim=box[:2], ylim=box[2:], aspect="equal")
    style.dress(upper, "x (m)", "y (m)", size=10.0)
    if track is not None:
        draw_road(upper, track)
    column, label = _distance(runs)
    styles, alone = style.method_styles(runs), len(runs) == 1
    span = max(box.right - box.left, box.top - box.bottom)
    longest = max(runs.values(), key=len)
    timeline = _timeline({label: lower}, longest, alone)
    lower.set_yscale("log")
    moving: list[Artist] = [*timeline]
    shows, handles, labels = [], [], []
    for method, steps in runs.items():
        look = style.Style(style.NOMINAL, "-", "o") if alone else styles[method]
        upper.plot(*paths[method][:1].T, **START, zorder=3)
        width = 0.9 if alone else 2.2 - 0.25 * look.place
        (line,) = lower.plot(steps["t"], steps[column].clip(lower=LEAST), linewidth=width)
        line.set(color=look.color, linestyle=look.linestyle)
        robot = _Robot(upper, steps, look.color, span, alone)
        moving += robot.moving
        shows.append(robot.show)
        handles += robot.handles if alone else [look.handle()]
        labels += robot.labels if alone else [method]
    style.legend_above(figure, handles, labels, title)
    words = _words(upper)

    def show(row: int) -> None:
        for each in shows:
            each(row)
        _tell(longest.iloc[row], timeline, words, alone)

    return Scene(figure, [*moving, words], show)


def _distance(runs: Mapping[str, pd.DataFrame]) -> tuple[str, str]:
    """Return which distance to draw over time, and what it is."""
    if all("miss" in steps and steps["miss"].notna().all() for steps in runs.values()):
        return "miss", "distance from\nthe plan"
    return "error", "error of\nthe model"


class _Robot:
    """One robot on a map: its line so far, its body, and alone its target and actions."""

    def __init__(
        self, axes: Axes, steps: pd.DataFrame, color: str, span: float, alone: bool
    ) -> None:
        self.path, self.span = positions(steps), span
        moved = np.diff(self.path, axis=0, prepend=self.path[:1])
        self.heading = (
            steps["theta"].to_numpy(dtype=float)
            if "theta" in steps
            else np.arctan2(moved[:, 1], moved[:, 0])
        )
        self.changed = np.where(
            changed_stretch(steps["regime_active"].to_numpy())[:, None], self.path, np.nan
        )
        (self.before,) = axes.plot([], [], **BEFORE | {"color": color}, zorder=4)
        after = CHANGED if alone else {"color": color, "linewidth": 2.4}
        (self.under,) = axes.plot([], [], **after, zorder=4)
        self.body = Polygon(BODY, facecolor=color, edgecolor="white", linewidth=0.8, zorder=7)
        axes.add_patch(self.body)
        self.moving: list[Artist] = [self.before, self.under, self.body]
        self.handles, self.labels = [self.before, self.under], ["nominal", "changed regime"]
        self.arrows: list[FancyArrowPatch] = []
        self.target = None
        if alone:
            self.goals = steps[["goal_x", "goal_y"]].to_numpy()
            (self.target,) = axes.plot([], [], **TARGET, zorder=5)
            self.handles, self.labels = [*self.handles, self.target], [*self.labels, "target"]
            self.moving.append(self.target)
        if alone and {"v", "omega"} <= set(action_names(steps)):
            self.courses = _courses(steps, self.heading) * 0.13 * span
            self.arrows = [_arrow(axes, PLANNED), _arrow(axes, EXECUTED)]
            self.handles += [Line2D([], [], **PLANNED), Line2D([], [], **EXECUTED)]
            self.labels += ["planned action", "executed action"]
            self.moving += self.arrows

    def show(self, row: int) -> None:
        """Go to a row; a robot that has ended stays where it is."""
        row = min(row, len(self.path) - 1)
        here = self.path[row]
        self.before.set_data(*self.path[: row + 1].T)
        self.under.set_data(*self.changed[: row + 1].T)
        if self.target is not None:
            self.target.set_data(*self.goals[row : row + 1].T)
        for arrow, course in zip(self.arrows, self.courses if self.arrows else (), strict=True):
            arrow.set_positions(here, here + course[row])
        cos, sin = np.cos(self.heading[row]), np.sin(self.heading[row])
        self.body.set_xy(here + 0.022 * self.span * BODY @ np.array([[cos, sin], [-sin, cos]]))


def space_scene(title: str, steps: pd.DataFrame) -> Scene:
    """Return the scene of a path in space, with the height and the first action over time.

    Args:
        title: what is shown.
        steps: one mission's steps, with :data:`COLUMNS`, ``z``, ``goal_z`` and actions.
    """
    figure, action = style.new_figure(9.6, 28 * GRID), action_names(steps)[0]
    grid = figure.add_gridspec(2, 2, width_ratios=[1.2, 1])
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    height, effort = (figure.add_subplot(grid[row, 1]) for row in (0, 1))
    path, wanted = (steps[names].to_numpy(dtype=float) for names in (POSITION, GOAL))
    space.plot(*wanted.T, **REFERENCE)
    space.plot(*path.T, alpha=0.0)  # so that the axes have room for all of it
    dress_space(space)

    height.plot(steps["t"], steps["goal_z"], **REFERENCE)
    height.plot(steps["t"], steps["z"], color=style.NOMINAL, linewidth=1.2)
    looks = (PLANNED | {"linewidth": 3.0}, EXECUTED | {"linewidth": 1.2})
    for kind, look in zip(("planned", "executed"), looks, strict=True):
        effort.plot(steps["t"], steps[f"{kind}_{action}"], **look)
    cursors = _timeline({"height (m)": height, action: effort}, steps, True)

    (line,) = space.plot([], [], [], color=style.NOMINAL, linewidth=1.4)
    (robot,) = space.plot([], [], [], "o", color=style.REGIME, markersize=7)
    (goal,) = space.plot([], [], [], **TARGET)
    words = _words(space)
    handles = [Line2D([], [], **REFERENCE), line, robot, goal]
    handles += [Line2D([], [], **look) for look in looks]
    labels = ["reference", "path", "now", "set-point", f"planned {action}", f"executed {action}"]
    style.legend_above(figure, handles, labels, title)

    def show(row: int) -> None:
        line.set_data_3d(*path[: row + 1].T)
        robot.set_data_3d(*path[row : row + 1].T)
        goal.set_data_3d(*wanted[row : row + 1].T)
        _tell(steps.iloc[row], cursors, words, True)

    return Scene(figure, [line, goal, robot, *cursors, words], show)


def _courses(steps: pd.DataFrame, heading: np.ndarray, ahead: float = 0.5) -> np.ndarray:
    """Return arrows ``(2, T, 2)`` of planned and executed actions, the longest of size 1.

    They turn for ``ahead`` seconds.
    """
    kinds = ("planned", "executed")
    fast, turning = (
        np.stack([steps[f"{kind}_{name}"].to_numpy(dtype=float) for kind in kinds])
        for name in ("v", "omega")
    )
    angle = heading + ahead * turning
    longest = max(float(np.nanmax(np.abs(fast))), LEAST)
    return np.stack([np.cos(angle), np.sin(angle)], -1) * (fast / longest)[..., None]


def _arrow(axes: Axes, look: style.Look) -> FancyArrowPatch:
    head: style.Look = {"arrowstyle": "-|>", "mutation_scale": 9 + look["linewidth"]}
    arrow = FancyArrowPatch((0, 0), (0, 0), shrinkA=0, shrinkB=0, zorder=6, **head, **look)
    axes.add_patch(arrow)
    return arrow


def _timeline(panels: Mapping[str, Axes], steps: pd.DataFrame, alone: bool) -> list[Line2D]:
    """Dress axes over time, by their labels; return the lines that mark now.

    Methods change at different steps: changes are marked of a method ``alone``.
    """
    if alone:
        mark_regimes([*panels.values()], steps)
    for label, axes in panels.items():
        last = axes is [*panels.values()][-1]
        style.dress(axes, "step" if last else "", label, size=10.0)
        axes.set_xlim(0, max(int(steps["t"].iloc[-1]), 1))
    return [axes.axvline(0, color=style.REGIME, linewidth=1.2) for axes in panels.values()]


def _words(axes: Any) -> Any:
    """Return an empty line above axes."""
    speak = axes.text2D if hasattr(axes, "text2D") else axes.text
    return speak(0.0, 1.01, "", transform=axes.transAxes, fontsize=style.NORMAL)


def _tell(step: Any, cursors: Sequence[Line2D], words: Any, alone: bool) -> None:
    """Move the cursors, and write the step and what is known of it."""
    for cursor in cursors:
        cursor.set_xdata([step["t"], step["t"]])
    text = f"step {int(step['t'])}"
    if alone:
        text += ": changed regime" if step["regime_active"] else ": nominal"
        text += ", misaligned" if step["misaligned"] else ""
    words.set_text(text)
