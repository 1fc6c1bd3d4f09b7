"""Methods side by side, by what counts."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from afm_rl.report import style
from afm_rl.report.kinds import Measure, kind_of
from afm_rl.report.summary import summarise

SPREAD = 0.26  # of a row: how far single missions lie off its middle


def draw_comparison(missions: pd.DataFrame) -> Figure:
    """Return a figure of mean success and mean number of steps of each method, or of mean errors.

    Large markers are means, with 95 % bootstrap intervals where there are any; small dots
    are single missions.

    Args:
        missions: one row per mission.
    """
    means = summarise(missions)
    styles = style.method_styles(means["method"])
    figure = style.new_figure(7.0, 1.1 + 0.42 * len(means))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, measure in zip(panels, kind_of(missions).measures, strict=True):
        for place, row in means.iterrows():
            single = missions.loc[missions["method"] == row["method"], measure.column]
            _draw_row(axes, int(place), row, measure, single, styles[row["method"]])
        axes.set_xlim(measure.limits or (0, 1.04 * measure.scale * missions[measure.column].max()))
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.set_xlabel(measure.label, fontsize=style.NORMAL)
        style.dress(axes)
        axes.grid(axis="x", color="#eeeeee", linewidth=0.6)
        axes.set_axisbelow(True)
    names = [style.literal(f"{row.method} (n = {row.missions})") for row in means.itertuples()]
    panels[0].set_yticks(range(len(means)), names, fontsize=style.NORMAL)
    panels[0].set_ylim(len(means) - 0.5, -0.5)
    style.footnote(figure, "mean with 95 % bootstrap interval; small dots are single missions")
    return figure


def _draw_row(
    axes: Axes,
    place: int,
    means: pd.Series,
    measure: Measure,
    single: pd.Series,
    look: style.Style,
) -> None:
    name, scale = measure.name, measure.scale
    offset = SPREAD * np.linspace(-1, 1, len(single)) if len(single) > 1 else 0.0
    axes.plot(
        scale * single, place + offset, ".", color=look.color, alpha=0.3, markersize=4, gid="single"
    )
    low, mean, high = (scale * means[key] for key in (f"{name}_low", name, f"{name}_high"))
    if math.isfinite(low):
        (bar,) = axes.plot([low, high], [place, place], "-|", color=look.color, gid="interval")
        bar.set(linewidth=1.8, markersize=11, markeredgewidth=1.8)
    axes.plot(
        mean,
        place,
        marker=look.marker,
        color=look.color,
        markeredgecolor="white",
        markersize=6.5,
        zorder=3,
        clip_on=False,
        gid="mean",
    )
