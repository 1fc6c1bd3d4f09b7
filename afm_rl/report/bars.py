"""Methods side by side: bars with intervals."""

from __future__ import annotations

import math

import pandas as pd
from matplotlib.figure import Figure

from afm_rl.report import style

CAPTION = (
    "Mean share of targets reached and interquartile mean of steps, over all missions of a "
    "method. Lines across the ends of the bars are 95 % intervals of the stratified bootstrap, "
    "seeds drawn anew within cells; a bar without one has no spread. More success and fewer "
    "steps are better."
)
PANELS = {
    "success": ("success", 100.0, "targets reached (%), mean"),
    "steps": ("steps_iqm", 1.0, "steps, interquartile mean"),
}


def draw_bars(means: pd.DataFrame, styles: dict[str, style.Style]) -> Figure:
    """Return a figure of bars: success and steps of each method.

    Args:
        means: from :func:`~afm_rl.report.aggregate.aggregate`.
        styles: how each method is drawn.
    """
    figure = style.new_figure(7.5, 1.0 + 0.32 * len(means))
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (name, scale, label) in zip(panels, PANELS.values(), strict=True):
        most = 0.0
        for place, row in enumerate(means.to_dict("records")):
            value, low, high = (scale * row[key] for key in (name, f"{name}_low", f"{name}_high"))
            color = styles[row["method"]].color
            # Pale, so that the interval shows on black, too.
            axes.barh(place, value, height=0.62, color=color, alpha=0.5, linewidth=0, gid="bar")
            end = value
            if math.isfinite(low):
                end = max(value, high)
                (line,) = axes.plot(
                    [low, high], [place, place], "-|", color="black", gid="interval"
                )
                line.set(linewidth=1.2, markersize=7, markeredgewidth=1.2)
            text = f"{value:.1f}" if scale > 1 else f"{value:.0f}"
            axes.annotate(text, (end, place), (4, 0), textcoords="offset points", va="center")
            axes.texts[-1].set_fontsize(style.SMALL)
            most = max(most, end)
        axes.set_xlim(0, 1.18 * max(most, 1e-9))
        axes.set_xlabel(label, fontsize=style.NORMAL)
        axes.grid(axis="x", color="#eeeeee", linewidth=0.6)
        axes.set_axisbelow(True)
        style.dress(axes)
    names = [style.literal(f"{row.method} (n = {row.missions})") for row in means.itertuples()]
    panels[0].set_yticks(range(len(means)), names, fontsize=style.NORMAL)
    panels[0].set_ylim(len(means) - 0.5, -0.5)
    panels[0].set_xticks(range(0, 101, 20))
    return figure
