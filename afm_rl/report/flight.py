"""Where flights went, how high, and with what thrust: one row per cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from afm_rl.report import style
from afm_rl.report.frames import first_missions, left_out, steps_of

CELLS = 3
PANELS = {
    "height": "error of the height (m)",
    "thrust": "thrust (N)",
    "distance": "distance to the reference (m)",
}
COLUMNS = [
    *("x", "y", "z", "goal_x", "goal_y", "goal_z", "planned_thrust", "executed_thrust"),
    *("square_error_x", "square_error_y", "square_error_z", "regime_active", "phase"),
]
REFERENCE: dict[str, Any] = {"color": style.FAINT, "linestyle": ":", "linewidth": 1.2}


def draw_flight(missions: pd.DataFrame, steps: pd.DataFrame) -> Figure:
    """Return a figure of flights, methods over each other, at most three cells below each other.

    Each row holds the path, the error of the height, the thrust (planned: thin; executed: thick)
    and the distance to the reference, its root mean square over each step. Lines across mark where
    a regime begins, crosses the same along the path; the stretch under a changed one is shaded. Of
    each method and cell, only the first seed is drawn.

    Args:
        missions: one row per mission.
        steps: one row per mission and step, with :data:`COLUMNS`: positions (m), thrust (N),
            squared errors (m^2).
    """
    first = first_missions(missions)
    cells = list(first["cell"].unique())[:CELLS]
    shown = first[first["cell"].isin(cells)]
    flights, styles = steps_of(steps, shown["mission"]), style.method_styles(missions["method"])
    figure = style.new_figure(12.5, 3.0 * len(cells) + 0.8)
    grid = figure.add_gridspec(len(cells), 4, width_ratios=[1.15, 1, 1, 1])
    for row, (cell, group) in enumerate(shown.groupby("cell", sort=False)):
        space = figure.add_subplot(grid[row, 0], projection="3d")
        panels = [figure.add_subplot(grid[row, k]) for k in (1, 2, 3)]
        panels[0].set_title(style.literal(str(cell)), fontsize=style.NORMAL, loc="left")
        for mission in group.itertuples():
            flight, look = flights[mission.mission], styles[mission.method]
            _draw_space(space, flight, look)
            _draw_courses(panels, flight, look)
        dress_space(space)
        _dress(panels, row == len(cells) - 1)
        mark_regimes(panels, flights[group["mission"].iloc[0]])
    handles = [
        Line2D([], [], color=look.color, linestyle=look.linestyle) for look in styles.values()
    ]
    handles += [
        Line2D([], [], **REFERENCE),
        Line2D([], [], color=style.FAINT, marker="X", linestyle=""),
        Line2D([], [], color=style.FAINT, linewidth=0.7),
    ]
    labels = [*styles, "reference", "a regime begins", "planned thrust (thin)"]
    style.legend_above(figure, handles, labels)
    style.footnote(figure, left_out(missions, shown))
    return figure


def changes(steps: pd.DataFrame) -> list[int]:
    """Return the steps at which a flight's phases begin, but for the first.

    >>> changes(pd.DataFrame({"t": [0, 1, 2, 3], "phase": [0, 0, 1, 2]}))
    [2, 3]
    """
    begun = np.diff(steps["phase"], prepend=steps["phase"].iloc[0]) != 0
    return steps.loc[begun, "t"].tolist()


def _draw_space(axes: Axes, flight: pd.DataFrame, look: style.Style) -> None:
    """Draw the path and the reference."""
    wanted = flight[["goal_x", "goal_y", "goal_z"]].to_numpy().T
    axes.plot(*wanted, **REFERENCE, gid="reference")
    flown = flight[["x", "y", "z"]].to_numpy()
    axes.plot(*flown.T, color=look.color, linestyle=look.linestyle, linewidth=1.2, gid="path")
    turns = flown[flight["t"].isin(changes(flight))]
    axes.plot(*turns.T, "X", color=look.color, markersize=5, gid="change")


def _draw_courses(panels: list[Axes], flight: pd.DataFrame, look: style.Style) -> None:
    """Draw what happens over time."""
    t, line = flight["t"], {"color": look.color, "linestyle": look.linestyle}
    height, thrust, distance = panels
    height.plot(t, flight["z"] - flight["goal_z"], **line, linewidth=1.3, gid="height")
    thrust.plot(t, flight["planned_thrust"], color=look.color, linewidth=0.7, gid="planned")
    thrust.plot(t, flight["executed_thrust"], **line, linewidth=1.5, gid="executed")
    square = flight[[f"square_error_{axis}" for axis in "xyz"]].sum(axis=1)
    distance.plot(t, np.sqrt(square), **line, linewidth=1.3, gid="distance")


def _dress(panels: list[Axes], last: bool) -> None:
    for axes, label in zip(panels, PANELS.values(), strict=True):
        axes.set_ylabel(label, fontsize=style.SMALL)
        axes.grid(axis="y", color="#eeeeee", linewidth=0.6)
        axes.set_xlim(left=0)
        style.dress(axes)
        if last:
            axes.set_xlabel("step", fontsize=style.SMALL)
    panels[2].set_yscale("log", nonpositive="mask")


def dress_space(space: Any) -> None:
    """Give axes in space their labels, and at least a metre of height."""
    for name in "xyz":
        getattr(space, f"set_{name}label")(f"{name} (m)", fontsize=style.SMALL, labelpad=-4)
    space.set_box_aspect(None, zoom=0.8)  # room for the label of z
    space.tick_params(labelsize=style.SMALL - 1, pad=-2)
    space.locator_params(nbins=4)
    low, high = space.get_zlim()
    if high - low < 1.0:  # a level flight is level
        space.set_zlim((low + high) / 2 - 0.5, (low + high) / 2 + 0.5)


def mark_regimes(panels: Sequence[Axes], steps: pd.DataFrame) -> None:
    """Shade the stretch under a changed regime; draw a line where a phase begins, if that is told.

    Args:
        panels: axes over ``t``.
        steps: one mission's steps, with ``t``, ``regime_active`` and, of flights, ``phase``.
    """
    active, t = steps["regime_active"].to_numpy(dtype=bool), steps["t"].to_numpy()
    for axes in panels:
        top = axes.get_xaxis_transform()
        axes.fill_between(
            t, 0, 1, where=active, color=style.BAND, alpha=0.15, linewidth=0, transform=top
        )
        for step in changes(steps) if "phase" in steps else ():
            axes.axvline(step, color=style.FAINT, linewidth=0.8, linestyle="--", gid="change")
