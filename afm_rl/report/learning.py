"""How well the models predicted, step by step."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import wrap

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from afm_rl.report import style
from afm_rl.report.curve import ENDS, STARTS, draw_curve, mark_regime
from afm_rl.report.frames import first_missions, left_out, steps_of
from afm_rl.report.kinds import kind_of

CELLS = 4
BEYOND = 1.15  # of the longest mission that finished: how far the axis of steps goes
LINEAR = 10.0  # losses up to here, of either sign, are drawn to a linear scale
LETTERS = 55  # that a line under one column has room for
ROWS = {"error": "prediction error\nper step ({units})", "loss": "model loss\n(NLL)"}


def draw_learning(missions: pd.DataFrame, steps: pd.DataFrame) -> Figure:
    """Return a figure of prediction error and model loss against the step.

    One column per cell, at most four, first seed only; the footnote says what is left out.
    Lines are moving averages over 20 steps, with the raw values faint behind them. Triangles
    mark where each method's changed regime starts and ends. Where some missions finish, the
    axis ends soon after the last of them, and its label names the methods that go on.

    Args:
        missions: one row per mission.
        steps: one row per mission and step.
    """
    first = first_missions(missions)
    shown = first[first["cell"].isin(first["cell"].unique()[:CELLS])]
    curves, styles = steps_of(steps, shown["mission"]), style.method_styles(missions["method"])
    columns = shown["cell"].nunique()
    figure = style.new_figure(max(3.4 * columns, 6.8), 4.4)
    grid = figure.subplots(2, columns, sharex="col", sharey="row", squeeze=False)
    for axes, (cell, rows) in zip(grid.T, shown.groupby("cell", sort=False), strict=True):
        axes[0].set_title(style.literal(str(cell)), fontsize=style.NORMAL, pad=8)
        axes[1].set_xlabel(_step_label(rows), fontsize=style.SMALL)
        for panel, column in zip(axes, ROWS, strict=True):
            panel.set_xlim(0, last_step(rows))
            for row in rows.itertuples():
                draw_curve(panel, curves[row.mission], column, styles[row.method])
                mark_regime(panel, curves[row.mission], styles[row.method], len(rows) == 1)
    _dress(grid, pd.concat(curves.values()), kind_of(missions).units)
    _legend(figure, styles)
    style.footnote(figure, left_out(missions, shown))
    return figure


def last_step(missions: pd.DataFrame) -> float:
    """Return where the axis of steps ends: soon after the last mission that finishes.

    >>> last_step(pd.DataFrame({"steps": [400, 5000], "finished": [True, False]}))
    460.0
    >>> last_step(pd.DataFrame({"steps": [400, 430], "finished": [True, False]}))
    430.0
    """
    longest = float(missions["steps"].max())
    finished = missions.loc[missions["finished"].astype(bool), "steps"]
    end = longest if finished.empty else round(min(longest, BEYOND * float(finished.max())))
    return max(1.0, float(end))


def _step_label(missions: pd.DataFrame) -> str:
    """Return the label of the axis of steps; it names the methods that go on beyond it.

    >>> missions = {"method": ["a", "b"], "steps": [400, 5000], "finished": [True, False]}
    >>> print(_step_label(pd.DataFrame(missions)))
    step
    b goes on to step 5000
    """
    lines = ["step"]
    beyond = missions[missions["steps"] > last_step(missions)]
    for step, rows in beyond.groupby("steps"):
        go = "goes" if len(rows) == 1 else "go"
        lines += wrap(f"{', '.join(rows['method'])} {go} on to step {step}", LETTERS)
    return style.literal("\n".join(lines))


def _dress(grid: np.ndarray, steps: pd.DataFrame, units: str) -> None:
    """Give the axes ``(2, C)`` scales that show these steps, and labels."""
    for panels, label in zip(grid, ROWS.values(), strict=True):
        panels[0].set_ylabel(label.format(units=units), fontsize=style.NORMAL)
        for panel in panels:
            panel.grid(axis="y", color="#eeeeee", linewidth=0.6)
            style.dress(panel)
    for panels, column in zip(grid, ROWS, strict=True):
        for panel in panels:
            scale_panel(panel, column, steps[column])


def scale_panel(axes: Axes, column: str, values: pd.Series) -> None:
    """Give axes a scale that shows these errors (positive), or losses (of either sign)."""
    if column == "error":
        if (values > 0).any():
            axes.set_yscale("log", nonpositive="mask")
    elif (values[np.isfinite(values)].abs() > LINEAR).any():
        axes.set_yscale("symlog", linthresh=LINEAR)


def _legend(figure: Figure, styles: Mapping[str, style.Style]) -> None:
    handles = [
        Line2D([], [], color=look.color, linestyle=look.linestyle, linewidth=1.7)
        for look in styles.values()
    ]
    for marker in (STARTS, ENDS):
        handles.append(Line2D([], [], color=style.FAINT, marker=marker, linestyle="", markersize=6))
    labels = [*styles, "changed regime starts", "ends"]
    style.legend_above(figure, handles, labels)
