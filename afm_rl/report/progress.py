"""How far missions have come by a step."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from afm_rl.report import style
from afm_rl.report.bootstrap import resample
from afm_rl.report.gather import Gathered
from afm_rl.report.interval import LEVEL

CAPTION = (
    "Share of the targets reached by a step, mean over all missions of a method; after its end a "
    "mission keeps its share. Higher and further left is better. Bands: 95 % intervals, seeds "
    "drawn anew within cells (none where all cells have one seed). The legend says how many "
    "missions each line is a mean of."
)
RESAMPLES = 500  # the band is as wide as a line: no need for more


def draw_progress(gathered: Gathered, styles: dict[str, style.Style]) -> Figure:
    """Return a figure of the mean share of targets reached against the number of steps.

    Args:
        gathered: with the progress of at least one method.
        styles: how each method is drawn.
    """
    figure = style.new_figure(7.0, 4.6)
    axes = figure.subplots()
    handles, labels = [], []
    grid = gathered.grid
    for place, (method, shares) in enumerate(gathered.progress.items()):
        look = styles[method]
        drawn = resample(gathered.missions[method]["cell"], RESAMPLES)
        # One resample at a time: all of them at once would be missions x steps x resamples.
        means = [shares[rows].mean(0) for rows in drawn]
        low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
        axes.fill_between(grid, 100 * low, 100 * high, color=look.color, alpha=0.15, linewidth=0)
        (line,) = axes.plot(grid, 100 * shares.mean(0), color=look.color, linewidth=1.5)
        line.set(linestyle=look.linestyle, marker=look.marker, markersize=5.0, gid="progress")
        line.set(markevery=(4 + 5 * place % 24, 24), markeredgecolor="white", markeredgewidth=0.5)
        handles.append(line)
        labels.append(f"{method} (n = {len(shares)})")
    axes.set_xlim(0, grid[-1])
    axes.set_ylim(0, 103)
    axes.set_xlabel("steps", fontsize=style.NORMAL)
    axes.set_ylabel("targets reached (%)", fontsize=style.NORMAL)
    axes.grid(color="#eeeeee", linewidth=0.6)
    style.dress(axes)
    style.legend_above(figure, handles, labels)
    return figure
