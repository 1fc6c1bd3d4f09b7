"""Where robots went in space, how high, and with what action: one row per scenario."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from afm_rl.report import style
from afm_rl.report.learning import regime_changes
from afm_rl.report.runs import action_names, steps_of

POSITION, GOAL = ["x", "y", "z"], ["goal_x", "goal_y", "goal_z"]
COLUMNS = [*POSITION, *GOAL, "regime_active"]  # of the steps


def draw_space(missions: pd.DataFrame, steps: pd.DataFrame, scenarios: int = 3) -> Figure:
    """Return a figure of paths in space, methods over each other, scenarios below each other.

    Each row holds the path, the error of the height, the first component of the action (planned:
    thin; executed: thick) and the distance to the reference. Of each method and scenario, only the
    first seed is drawn, of six methods at most.

    Args:
        missions: one row per mission.
        steps: one row per mission and step, with :data:`COLUMNS` (m) and actions.
        scenarios: number of scenarios shown.
    """
    shown, styles, left_out = style.excerpt(missions, scenarios)
    flights, action = steps_of(steps, shown["mission"]), action_names(steps)[0]
    rows = shown["scenario"].nunique()
    figure = style.new_figure(12.5, 3.0 * rows + 0.8)
    grid = figure.add_gridspec(rows, 4, width_ratios=[1.15, 1, 1, 1])
    labels = ("error of the height (m)", action, "distance to the reference (m)")
    for row, (scenario, group) in enumerate(shown.groupby("scenario", sort=False)):
        space = figure.add_subplot(grid[row, 0], projection="3d")
        panels = [figure.add_subplot(grid[row, k]) for k in (1, 2, 3)]
        for axes, label in zip(panels, labels, strict=True):
            style.dress(axes, "step" * (row == rows - 1), label, "y")
        panels[0].set_title(style.literal(str(scenario)), fontsize=style.NORMAL, loc="left")
        for mission in group.itertuples():
            flight, look = flights[mission.mission], styles[mission.method]
            _draw_path(space, flight, look)
            _draw_over_time(panels, flight, look, action)
        dress_space(space)
        mark_regimes(panels, flights[group["mission"].iloc[0]])
        panels[2].set_yscale("log", nonpositive="mask")
    handles = [look.handle() for look in styles.values()]
    handles += [
        Line2D([], [], **style.REFERENCE),
        Line2D([], [], color=style.FAINT, marker="X", linestyle=""),
        Line2D([], [], color=style.FAINT, linewidth=0.7),
    ]
    marks = ["reference", "a regime begins or ends", f"planned {action} (thin)"]
    style.legend_above(figure, handles, [*styles, *marks])
    style.footnote(figure, left_out)
    return figure


def changes(steps: pd.DataFrame) -> list[int]:
    """Return the steps at which the regime changes, each phase of a mission told apart if logged.

    >>> changes(pd.DataFrame({"t": [0, 1, 2, 3], "regime_active": [0, 0, 1, 1]}))
    [2]
    >>> changes(pd.DataFrame({"t": [0, 1, 2, 3], "phase": [0, 0, 1, 2]}))
    [2, 3]
    """
    if "phase" not in steps:
        return sorted(sum(regime_changes(steps), []))
    begun = np.diff(steps["phase"], prepend=steps["phase"].iloc[0]) != 0
    return steps.loc[begun, "t"].tolist()


def _draw_path(space: Any, flight: pd.DataFrame, look: style.Style) -> None:
    space.plot(*flight[GOAL].to_numpy().T, **style.REFERENCE, gid="reference")
    flown = flight[POSITION].to_numpy()
    space.plot(*flown.T, color=look.color, linestyle=look.linestyle, linewidth=1.2, gid="path")
    turns = flown[flight["t"].isin(changes(flight))]
    space.plot(*turns.T, "X", color=look.color, markersize=5, gid="change")


def _draw_over_time(
    panels: Sequence[Axes], flight: pd.DataFrame, look: style.Style, action: str
) -> None:
    t, (height, effort, distance) = flight["t"], panels
    look.line(height, t, flight["z"] - flight["goal_z"], gid="height")
    effort.plot(t, flight[f"planned_{action}"], color=look.color, linewidth=0.7, gid="planned")
    look.line(effort, t, flight[f"executed_{action}"], gid="executed")
    apart = flight[POSITION].to_numpy() - flight[GOAL].to_numpy()
    look.line(distance, t, np.linalg.norm(apart, axis=-1), gid="distance")
    for axes in panels:
        axes.set_xlim(left=0)


def dress_space(space: Any) -> None:
    """Give axes in space their labels, and at least a metre of height."""
    for name in POSITION:
        getattr(space, f"set_{name}label")(f"{name} (m)", fontsize=style.SMALL, labelpad=-4)
    space.set_box_aspect(None, zoom=0.8)  # room for the label of z
    space.tick_params(labelsize=style.SMALL - 1, pad=-2)
    space.locator_params(nbins=4)
    low, high = space.get_zlim()
    if high - low < 1.0:  # a level flight is level
        space.set_zlim((low + high) / 2 - 0.5, (low + high) / 2 + 0.5)


def mark_regimes(panels: Sequence[Axes], steps: pd.DataFrame) -> None:
    """Shade the stretch under a changed regime; draw a line at each change."""
    active, t = steps["regime_active"].to_numpy(dtype=bool), steps["t"].to_numpy()
    for axes in panels:
        look: style.Look = {"color": style.BAND, "alpha": 0.15, "linewidth": 0}
        axes.fill_between(t, 0, 1, where=active, **look, transform=axes.get_xaxis_transform())
        for step in changes(steps):
            line = axes.axvline(step, color=style.FAINT, linewidth=0.8, linestyle="--")
            line.set_gid("change")
