"""One method's curve against the step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from afm_rl.report.style import BAND, Style

WINDOW = 20  # steps in the moving average
POINTS = 800  # more than the picture has room for
RAW: dict[str, Any] = {"linewidth": 0.5, "alpha": 0.3, "zorder": 1.5}
STARTS, ENDS = ">", "<"  # markers; together they bracket the stretch


def draw_curve(
    axes: Axes, steps: pd.DataFrame, column: str, look: Style, many: bool = False
) -> None:
    """Draw a column's moving average, and its raw values faint behind it.

    Args:
        axes: where to; the limits of the steps must be set.
        steps: one mission's steps, in order.
        column: what to draw.
        look: how the mission's method is drawn.
        many: there are many methods in these axes: leave out the raw values, and put markers on
            the lines.
    """
    shown = steps[steps["t"] <= axes.get_xlim()[1]]
    values = shown[column].where(np.isfinite(shown[column]))
    mean = values.rolling(WINDOW, min_periods=1).mean()
    t, stride = shown["t"].to_numpy(), math.ceil(len(shown) / POINTS)
    if not many:
        axes.plot(*extremes(t, values, stride), color=look.color, **RAW, gid="raw")
    (line,) = axes.plot(t[::stride], mean[::stride], color=look.color, linewidth=1.7, gid="mean")
    line.set_linestyle(look.linestyle)
    if many:
        line.set(linewidth=1.3, marker=look.marker, markersize=4.5, markevery=(0.05, 0.3))
        line.set(markeredgecolor="white", markeredgewidth=0.5)


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


def mark_regime(
    axes: Axes, steps: pd.DataFrame, look: Style, alone: bool, lines: bool = True
) -> None:
    """Mark where the changed regime starts and ends.

    Args:
        axes: where to.
        steps: one mission's steps.
        look: how its method is drawn.
        alone: no other method is in these axes, so there is room to shade the stretch.
        lines: draw a line across the axes at each change, not the triangle alone.
    """
    changes, limit = regime_changes(steps), axes.get_xlim()[1]
    top = axes.get_xaxis_transform()  # steps across, 0 to 1 upwards
    for places, marker in zip(changes, (STARTS, ENDS), strict=True):
        seen = [place for place in places if place <= limit]
        if seen and lines:
            across = axes.vlines(seen, 0, 1, color=look.color, linewidth=1.0, transform=top)
            across.set(linestyle=look.linestyle, zorder=1, gid="change")
        if seen:
            (marks,) = axes.plot(seen, [1.0] * len(seen), marker, color=look.color, transform=top)
            marks.set(markersize=6, clip_on=False, gid="change")
    if alone:
        last = int(steps["t"].iloc[-1])
        for start, end in zip(changes[0], [*changes[1], last], strict=False):
            axes.axvspan(start, end, color=BAND, alpha=0.2, linewidth=0, zorder=0.5, gid="band")
