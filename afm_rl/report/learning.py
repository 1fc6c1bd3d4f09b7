"""Whether plans came true, and how well the models predicted, step by step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from afm_rl.report import style
from afm_rl.report.frames import first_missions, left_out, steps_of

CELLS = 4
BEYOND = 1.15  # of the longest mission that finished: how far the axis of steps goes
LINEAR = 10.0  # losses up to here, of either sign, are drawn to a linear scale
LETTERS = 50  # that a line under one column has room for
WINDOW = 20  # steps in the moving average
POINTS = 800  # more than the picture has room for
RAW: dict[str, Any] = {"linewidth": 0.5, "alpha": 0.25, "zorder": 1.5}
STARTS, ENDS = ">", "<"  # markers; together they bracket the stretch
QUANTITIES = {
    "miss": "distance from\nthe plan{units}",
    "unforeseen": "distance from\nthe prediction{units}",
    "error": "model's error{units}",
    "loss": "model's loss\n(NLL)",
}
CAPTION = (
    "One column per cell, one seed. Top: how far the robot was after each step from where the plan "
    "wanted it. Low soon after a change: plans come true again. Second: how far from where model "
    "and correction together predicted it; where a plan cannot be achieved under the changed "
    "regime, this one is low and the first is not. Third: how far from what the model alone "
    "predicts of the executed action; a frozen model under a correction never improves here. Last: "
    "the model's loss; losses of different kinds of model do not compare. Lines are moving "
    "averages over 20 steps. Triangles mark where each method's changed regime starts and ends: "
    "the sooner they come, the faster the method was."
)


def draw_learning(missions: pd.DataFrame, steps: pd.DataFrame, units: str = "") -> Figure:
    """Return a figure of what came true of plans and predictions against the step.

    Rows: the distance from the plan, from the prediction, the model's error and its loss, as far
    as the steps have them. One column per cell, at most four, first seed and six methods only; the
    footnote says what is left out. Lines are moving averages over 20 steps, with the raw values
    faint behind them if there are few. Triangles mark where each method's changed regime starts
    and ends. Where some missions finish, the axis ends soon after the last of them, and its label
    names the methods that go on.

    Args:
        missions: one row per mission.
        steps: one row per mission and step.
        units: of the model's error.
    """
    first, styles = first_missions(missions), style.method_styles(missions["method"])
    styles = dict([*styles.items()][: style.FEW])
    cells = first["cell"].unique()[:CELLS]
    shown = first[first["cell"].isin(cells) & first["method"].isin(list(styles))]
    curves = steps_of(steps, shown["mission"])
    rows = [name for name in QUANTITIES if name in steps and np.isfinite(steps[name]).any()]
    figure = style.new_figure(max(3.4 * len(cells), 7.2), 1.0 + 1.5 * len(rows))
    grid = figure.subplots(len(rows), len(cells), sharex="col", sharey="row", squeeze=False)
    for column, (cell, own) in zip(grid.T, shown.groupby("cell", sort=False), strict=True):
        column[0].set_title(style.literal(str(cell)), fontsize=style.NORMAL, pad=8)
        column[-1].set_xlabel(_step_label(own), fontsize=style.SMALL)
        for panel, name in zip(column, rows, strict=True):
            panel.set_xlim(0, last_step(own))
            for row in own.itertuples():
                look = styles[row.method]
                _draw_curve(panel, curves[row.mission], name, look, raw=len(own) <= 3)
                _mark_regime(panel, curves[row.mission], look, alone=len(own) == 1)
    for panels, name in zip(grid, rows, strict=True):
        label = QUANTITIES[name].format(units=f"\n({units})" if units else "")
        panels[0].set_ylabel(label, fontsize=style.SMALL)
        for panel in panels:
            style.grid(panel, "y")
            style.dress(panel)
            _scale(panel, name, pd.concat(curves.values())[name])
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
    longest, goal = float(missions["steps"].max()), "finished" in missions
    finished = missions.loc[missions["finished"].astype(bool) if goal else [], "steps"]
    end = longest if finished.empty else round(min(longest, BEYOND * float(finished.max())))
    return max(1.0, float(end))


def extremes(t: np.ndarray, values: pd.Series, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest of every ``stride`` values: fewer points, same look.

    >>> t, values = extremes(np.arange(4), pd.Series([3.0, 1.0, 2.0, 5.0]), 2)
    >>> t.tolist(), values.tolist()
    ([0, 0, 2, 2], [1.0, 3.0, 2.0, 5.0])
    """
    if stride == 1:
        return t, values.to_numpy()
    bins = values.groupby(np.arange(len(values)) // stride)
    return t[::stride].repeat(2), bins.agg(["min", "max"]).to_numpy().ravel()


def regime_changes(steps: pd.DataFrame) -> tuple[list[int], list[int]]:
    """Return the steps at which the changed regime starts, and those at which it has ended.

    A regime that lasts to the end of the mission has no end.

    >>> steps = pd.DataFrame({"t": range(5), "regime_active": [0, 1, 1, 0, 1]})
    >>> regime_changes(steps)
    ([1, 4], [3])
    """
    active = steps["regime_active"].to_numpy().astype(int)
    change, t = np.diff(active, prepend=0), steps["t"].to_numpy()
    return t[change == 1].tolist(), t[change == -1].tolist()


def _draw_curve(
    axes: Axes, steps: pd.DataFrame, name: str, look: style.Style, raw: bool = True
) -> None:
    """Draw a column's moving average, and its raw values faint behind it."""
    shown = steps[steps["t"] <= axes.get_xlim()[1]]
    values = shown[name].where(np.isfinite(shown[name]))
    t, stride = shown["t"].to_numpy(), max(1, math.ceil(len(shown) / POINTS))
    if raw:
        axes.plot(*extremes(t, values, stride), color=look.color, **RAW, gid="raw")
    mean = values.rolling(WINDOW, min_periods=1).mean()
    look.line(axes, t[::stride], mean[::stride], gid="mean")


def _mark_regime(axes: Axes, steps: pd.DataFrame, look: style.Style, alone: bool) -> None:
    """Mark where the changed regime starts and ends; shade the stretch of a method alone."""
    changes, limit = regime_changes(steps), axes.get_xlim()[1]
    top = axes.get_xaxis_transform()  # steps across, 0 to 1 upwards
    for places, marker in zip(changes, (STARTS, ENDS), strict=True):
        seen = [place for place in places if place <= limit]
        if seen:
            across = axes.vlines(seen, 0, 1, color=look.color, linewidth=1.0, transform=top)
            across.set(linestyle=look.linestyle, zorder=1, gid="change")
            (marks,) = axes.plot(seen, [1.0] * len(seen), marker, color=look.color, transform=top)
            marks.set(markersize=6, clip_on=False, gid="change")
    if alone:
        last = int(steps["t"].iloc[-1])
        for start, end in zip(changes[0], [*changes[1], last], strict=False):
            axes.axvspan(
                start, end, color=style.BAND, alpha=0.2, linewidth=0, zorder=0.5, gid="band"
            )


def _scale(axes: Axes, name: str, values: pd.Series) -> None:
    """Give axes a scale that shows these distances (positive), or losses (of either sign)."""
    if name != "loss":
        if (values > 0).any():
            axes.set_yscale("log", nonpositive="mask")
    elif (values[np.isfinite(values)].abs() > LINEAR).any():
        axes.set_yscale("symlog", linthresh=LINEAR)


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


def _legend(figure: Figure, styles: Mapping[str, style.Style]) -> None:
    handles: Sequence[Line2D] = [look.handle() for look in styles.values()]
    faint: dict[str, Any] = {"color": style.FAINT, "linestyle": "", "markersize": 6}
    marks = [Line2D([], [], marker=marker, **faint) for marker in (STARTS, ENDS)]
    style.legend_above(figure, [*handles, *marks], [*styles, "changed regime starts", "ends"])
