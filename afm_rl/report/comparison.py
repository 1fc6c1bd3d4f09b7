"""Methods side by side: by means, and by progress against the step."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from afm_rl.report import style
from afm_rl.report.statistics import count_budgets, resampled_bounds, split, summarise
from afm_rl.storage.measures import Measure, Measures


def draw_comparison(missions: pd.DataFrame, measures: Measures, panels: int = 3) -> Figure:
    """Return a figure of the means of each method, one panel for each of the first measures.

    Large markers are means, with 95 % bootstrap intervals if available; small dots are single
    missions. If there are more methods than colours, all have the same colour.

    Args:
        missions: one row per mission.
        measures: measures for the comparison.
        panels: number of measures shown.
    """
    means, counted = summarise(missions, measures), count_budgets(missions, measures)
    styles, shown = style.method_styles(means["method"]), measures.each[:panels]
    if len(means) > style.FEW:
        styles = dict.fromkeys(styles, style.Style(style.NOMINAL, "-", "o"))
    figure = style.new_figure(1.6 + 2.9 * len(shown), 1.1 + 0.42 * len(means))
    grid = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axes, measure in zip(grid, shown, strict=True):
        name, scale = measure.column, measure.scale
        for place, row in enumerate(means.to_dict("records")):
            look = styles[row["method"]]
            single = scale * counted.loc[counted["method"] == row["method"], name]
            apart = 0.26 * np.linspace(-1, 1, len(single)) if len(single) > 1 else 0.0
            dots: style.Look = {"color": look.color, "alpha": 0.3, "markersize": 4}
            axes.plot(single, place + apart, ".", **dots, gid="single")
            low, mean, high = (scale * row[key] for key in (f"{name}_low", name, f"{name}_high"))
            if math.isfinite(low):
                ends: style.Look = {"color": look.color, "linewidth": 1.8, "markeredgewidth": 1.8}
                axes.plot([low, high], [place] * 2, "-|", **ends, markersize=11, gid="interval")
            (dot,) = axes.plot(mean, place, look.marker, color=look.color, markersize=6.5)
            dot.set(markeredgecolor="white", zorder=3, clip_on=False, gid="mean")
        axes.set_xlim(*_limits(measure, counted[name]))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        label = f"{measure.label}\n{measure.better} is better"
        style.dress(axes, label, lines="x", size=style.NORMAL)
    names = [style.literal(f"{row.method} (n = {row.missions})") for row in means.itertuples()]
    grid[0].set_yticks(range(len(means)), names, fontsize=style.NORMAL)
    grid[0].set_ylim(len(means) - 0.5, -0.5)
    style.footnote(figure, "mean with 95 % bootstrap interval; small dots are single missions")
    return figure


def _limits(measure: Measure, values: pd.Series) -> tuple[float, float]:
    """Return the ends of an axis, a little beyond those of the measure, or beyond 0 and values."""
    low, high = measure.limits or (min(0.0, values.min()), max(0.0, values.max()))
    margin = 0.04 * (high - low) or 1.0
    return measure.scale * (low - margin), measure.scale * (high + margin)


def draw_progress(
    progress: pd.DataFrame, styles: Mapping[str, style.Style], name: str, resamples: int = 500
) -> Figure:
    """Return a figure of the mean share of what was reached against the number of steps."""

    def mean(samples: list[np.ndarray]) -> np.ndarray:
        return np.concatenate(samples, -1).mean(-1)

    steps = progress.columns.to_numpy(dtype=float)
    figure = style.new_figure(7.0, 4.6)
    axes, lines, labels = figure.subplots(), [], []
    for method, look in styles.items():
        shares = progress.loc[[method]]
        lines.append(look.line(axes, steps, 100 * shares.to_numpy().mean(0), gid="progress"))
        labels.append(f"{method} (n = {len(shares)})")
        samples = split(shares.to_numpy(), shares.index.get_level_values("scenario"))
        low, high = resampled_bounds(samples, mean, resamples)
        band: style.Look = {"color": look.color, "alpha": 0.15, "linewidth": 0}
        axes.fill_between(steps, 100 * low, 100 * high, **band)
    axes.set(xlim=(0, steps[-1]), ylim=(0, 103))
    style.dress(axes, "steps", f"{name} (%)", "both", style.NORMAL)
    style.legend_above(figure, lines, labels)
    return figure
