"""Scenes of films, drawn from the table of steps: robots on a map, or in space."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from afm_rl.errors import ConfigurationError
from afm_rl.film import Moves, Scene, frames, shown, trail
from afm_rl.report import style
from afm_rl.report.learning import last_step
from afm_rl.report.runs import action_names
from afm_rl.report.space_plot import GOAL, POSITION, dress_space, mark_regimes
from afm_rl.report.style import BEFORE, CHANGED, EXECUTED, FEW, PLANNED, REFERENCE, START, TARGET
from afm_rl.report.trajectory import DrawableTrack, changed_stretch, draw_road, positions, view

COLUMNS = ("x", "y", "goal_x", "goal_y", "miss", "corrected", "regime_active")  # at least
BODY = np.array([[1.0, 0.0], [-0.8, 0.65], [-0.4, 0.0], [-0.8, -0.65]])  # seen from above
GRID = 0.16  # inches: sides of pictures are multiples of 16 pixels, as video codecs want them


def films_of(
    missions: pd.DataFrame, steps: Mapping[str, pd.DataFrame], roads: Mapping[str, DrawableTrack]
) -> Iterator[tuple[str, Iterator[np.ndarray]]]:
    """Yield the pictures of the methods' missions, under their names.

    Several methods on a map, in the first scenario and six at most, are in one film, under the
    name "", until soon after the last one finished.

    Raises:
        ConfigurationError: if a column of :data:`COLUMNS` is missing.
    """
    tables = steps.values()
    missing = [k for k in COLUMNS if any(k not in rows or rows[k].isna().all() for rows in tables)]
    if missing:
        raise ConfigurationError(
            f"video: the steps lack {', '.join(missing)}; films are drawn of robots with positions"
        )
    space = any({"z", "goal_z"} <= set(rows.dropna(axis=1, how="all")) for rows in tables)
    scenario = missions["scenario"].iloc[0]
    beside = missions[missions["scenario"] == scenario][:FEW]
    if len(beside) > 1 and not space:
        end, road = last_step(beside), roads.get(beside["track"].iloc[0])
        runs = {name: steps[name].loc[steps[name]["t"] <= end] for name in beside["method"]}
        scene = map_scene(f"ground robot: {scenario}", runs, road)
        yield "", frames(scene, shown(max(map(len, runs.values()))))
        missions = missions.drop(beside.index)
    for mission in missions.itertuples():
        name, rows, road = mission.method, steps[mission.method], roads.get(mission.track)
        robot = "flying robot" if space else "ground robot"
        title = f"{robot}, {name}: {mission.scenario}"
        scene = space_scene(title, rows) if space else map_scene(title, {name: rows}, road)
        yield name, frames(scene, shown(len(rows)))


def map_scene(
    title: str, runs: Mapping[str, pd.DataFrame], track: DrawableTrack | None = None
) -> Scene:
    """Return the scene of robots on a map, and their distance from the plan over time under it.

    A robot alone has its target. Several robots move at the same time; where their paths are the
    same, the oracle's is the widest one and at the bottom, and that of AFM on top.
    """
    box = view(track, [positions(steps) for steps in runs.values()])
    tall = 5.6 * np.clip(box.height / box.width, 0.4, 1.2)
    figure = style.new_figure(6.4, GRID * round((tall + 2.3) / GRID), dpi=100)
    upper, lower = figure.subplots(2, 1, height_ratios=[tall, 1.1])
    upper.set(xlim=box.intervalx, ylim=box.intervaly, aspect="equal")
    style.dress(upper, "x (m)", "y (m)", size=style.LARGE)
    if track is not None:
        draw_road(upper, track)
    styles, alone, longest = style.method_styles(runs), len(runs) == 1, max(runs.values(), key=len)
    moving = _cursors({"distance from\nthe plan": lower}, longest, alone)
    lower.set_yscale("log", subs=[])  # without minor ticks, which take time
    handles: dict[str, Artist] = {}
    for depth, method in reversed([*enumerate(sorted(runs, key=style.depth_of))]):
        steps = runs[method]
        look = style.Style(style.NOMINAL, "-", "o") if alone else styles[method]
        upper.plot(*positions(steps)[:1].T, **START, zorder=3)
        width = 0.9 if alone else 1.5 + 0.6 * depth
        (line,) = lower.plot(steps["t"], steps["miss"].clip(lower=1e-6), linewidth=width)
        line.set(color=look.color, linestyle=look.linestyle)
        robot, named = _robot(upper, steps, look.color, max(box.size), alone, width)
        moving |= robot
        handles |= named
    if not alone:
        handles = {method: look.handle() for method, look in styles.items()}
    style.legend_above(figure, [*handles.values()], [*handles], title)
    return Scene(figure, moving | _words(upper, longest, alone))


def _robot(
    axes: Axes, steps: pd.DataFrame, color: str, span: float, alone: bool, width: float
) -> tuple[Moves, dict[str, Artist]]:
    """Draw a robot on a map; return what moves, and what stands in the legend."""
    path = positions(steps)
    moved = np.diff(path, axis=0, prepend=path[:1])
    heading = (
        steps["theta"].to_numpy(dtype=float) if "theta" in steps else np.arctan2(*moved.T[::-1])
    )
    stretch = changed_stretch(steps["regime_active"].to_numpy())
    changed = np.where(stretch[:, None], path, np.nan)
    thin, broad, size = BEFORE, CHANGED, 0.022 * span
    if not alone:
        thin, broad = ({"color": color, "linewidth": part * width} for part in (0.6, 1.0))
        size *= 0.85 + 0.1 * width
    (before,) = axes.plot([], [], **thin | {"color": color}, zorder=4)
    (under,) = axes.plot([], [], **broad, zorder=4)
    body = Polygon(BODY, facecolor=color, edgecolor="white", linewidth=0.8, zorder=7)
    axes.add_patch(body)

    def turn(row: int) -> None:
        row = min(row, len(path) - 1)
        cos, sin = np.cos(heading[row]), np.sin(heading[row])
        body.set_xy(path[row] + size * BODY @ np.array([[cos, sin], [-sin, cos]]))

    moving: Moves = {
        before: trail(before, *path.T),
        under: trail(under, *changed.T),
        body: turn,
    }
    handles: dict[str, Artist] = {"nominal": before, "changed regime": under}
    if alone:
        goals = steps[["goal_x", "goal_y"]].to_numpy()
        (target,) = axes.plot([], [], **TARGET, zorder=5)
        moving[target] = trail(target, *goals.T, longest=1)
        handles["target"] = target
    return moving, handles


def space_scene(title: str, steps: pd.DataFrame) -> Scene:
    """Return the scene of a path in space, with the height and the first action over time."""
    figure, action = style.new_figure(9.6, 28 * GRID, dpi=100), action_names(steps)[0]
    grid = figure.add_gridspec(2, 2, width_ratios=[1.2, 1])
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    height, effort = (figure.add_subplot(grid[row, 1]) for row in (0, 1))
    path, wanted = (steps[names].to_numpy(dtype=float) for names in (POSITION, GOAL))
    space.plot(*wanted.T, **REFERENCE)
    space.plot(*path.T, alpha=0.0)  # so that the axes have room for all of it
    dress_space(space)

    height.plot(steps["t"], steps["goal_z"], **REFERENCE)
    height.plot(steps["t"], steps["z"], color=style.NOMINAL, linewidth=1.2)
    looks = {
        f"planned {action}": PLANNED | {"linewidth": 3.0},
        f"executed {action}": EXECUTED | {"linewidth": 1.2},
    }
    for name, look in looks.items():
        effort.plot(steps["t"], steps[name.replace(" ", "_", 1)], **look)
    cursors = _cursors({"height (m)": height, action: effort}, steps, True)

    (line,) = space.plot([], [], [], color=style.NOMINAL, linewidth=1.4)
    (robot,) = space.plot([], [], [], "o", color=style.REGIME, markersize=7)
    (goal,) = space.plot([], [], [], **TARGET)
    handles = {"reference": Line2D([], [], **REFERENCE), "path": line, "now": robot}
    handles |= {"set-point": goal}
    handles |= {name: Line2D([], [], **look) for name, look in looks.items()}
    style.legend_above(figure, [*handles.values()], [*handles], title)
    moving: Moves = {
        line: trail(line, *path.T),
        goal: trail(goal, *wanted.T, longest=1),
        robot: trail(robot, *path.T, longest=1),
    }
    return Scene(figure, moving | cursors | _words(space, steps, True))


def state_of(step: pd.Series) -> str:
    """Return the caption of a step: its number, the regime, and whether it was corrected.

    >>> state_of(pd.Series({"t": 3, "regime_active": 1, "corrected": 0}))
    'step 3: changed regime'
    """
    text = f"step {int(step['t'])}: {'changed regime' if step['regime_active'] else 'nominal'}"
    return f"{text}, corrected" if step["corrected"] else text


def _cursors(panels: Mapping[str, Axes], steps: pd.DataFrame, alone: bool) -> Moves:
    """Dress axes over time, by their labels; return the lines that mark now."""
    if alone:
        mark_regimes([*panels.values()], steps)
    moving: Moves = {}
    t, lowest = steps["t"].to_numpy(), list(panels)[-1]
    for label, axes in panels.items():
        style.dress(axes, "step" if label == lowest else "", label, size=style.LARGE)
        axes.set_xlim(0, max(int(t[-1]), 1))
        line = axes.axvline(0, color=style.REGIME, linewidth=1.2)
        moving[line] = partial(_mark, line, t)
    return moving


def _mark(line: Line2D, t: np.ndarray, row: int) -> None:
    line.set_xdata([t[row]] * 2)


def _words(axes: Any, steps: pd.DataFrame, alone: bool) -> Moves:
    """Return a line above axes with the step and, of a robot alone, its state."""
    speak = axes.text2D if hasattr(axes, "text2D") else axes.text
    words = speak(0.0, 1.01, "", transform=axes.transAxes, fontsize=style.NORMAL)

    def tell(row: int) -> None:
        step = steps.iloc[row]
        words.set_text(state_of(step) if alone else f"step {int(step['t'])}")

    return {words: tell}
