"""Methods side by side: by means, by shares of missions, by progress against the step."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from afm_rl.report import style
from afm_rl.report.statistics import count_budgets, resampled_bounds, split, summarise
from afm_rl.storage.measures import Measure, Measures


def draw_comparison(missions: pd.DataFrame, measures: Measures, panels: int = 3) -> Figure:
    """Return a figure of the means of each method, one panel for each of the first measures.

    Large markers are means, with 95 % bootstrap intervals where there are any; small dots
    are single missions. More methods than there are colours are all drawn in one.

    Args:
        missions: one row per mission.
        measures: what methods are compared by.
        panels: how many measures are shown.
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
    """Return the ends of an axis: those of the measure, or from 0 to a little beyond all values."""
    if measure.limits is not None:
        low, high = (measure.scale * limit for limit in measure.limits)
        return low - 0.04 * (high - low), high + 0.04 * (high - low)
    low, high = min(0.0, measure.scale * values.min()), max(0.0, measure.scale * values.max())
    margin = 0.04 * (high - low) if high > low else 1.0
    return (low - margin if low < 0 else 0.0), (high + margin if high > 0 else 0.0)


def ratios(missions: pd.DataFrame, spent: Measure) -> pd.Series:
    """Return what each mission spent over the least of its scenario and seed; inf if not finished.

    >>> steps = Measure("steps", "steps", "steps", budget=True)
    >>> rows = {"scenario": "a", "seed": 0, "steps": [199, 99, 99], "finished": [True, True, False]}
    >>> ratios(pd.DataFrame(rows), steps).tolist()
    [2.0, 1.0, inf]
    """
    made = (missions[spent.column] + 1.0).where(missions["finished"].astype(bool), np.inf)
    fewest = made.groupby([missions["scenario"], missions["seed"]]).transform("min")
    return (made / fewest).fillna(np.inf)


def draw_profile(
    missions: pd.DataFrame,
    ratio: pd.Series,
    spent: Measure,
    styles: Mapping[str, style.Style],
    widest: float = 20.0,
) -> Figure:
    """Return a figure of the share of missions within a factor of the least."""
    finite = ratio[np.isfinite(ratio)]
    limit = float(np.clip(finite.max() if len(finite) else 2.0, 2.0, widest))
    taus, shares, counts = np.geomspace(1.0, limit, 200), {}, {}
    for method in styles:
        own = ratio[missions["method"] == method]
        counts[method] = len(own)
        shares[method] = np.searchsorted(np.sort(own), taus * (1 + 1e-9), side="right") / len(own)
    steps: style.Look = {"gid": "profile", "drawstyle": "steps-post", "clip_on": False}
    figure = _draw(taus, shares, counts, styles, steps)
    (axes,) = figure.axes
    axes.set(xscale="log", xlim=(1.0, limit))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda tau, _: f"{tau:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    below = f"tau: {spent.name} / fewest {spent.name} of any method"
    style.dress(axes, below, "missions finished within tau (%)", "both", style.NORMAL)
    return figure


def draw_progress(
    progress: pd.DataFrame, styles: Mapping[str, style.Style], name: str, resamples: int = 500
) -> Figure:
    """Return a figure of the mean share of what was reached against the number of steps."""

    def mean(samples: list[np.ndarray]) -> np.ndarray:
        return np.concatenate(samples, -1).mean(-1)

    grid = progress.columns.to_numpy(dtype=float)
    own = {method: progress.loc[[method]] for method in styles}
    means = {method: rows.to_numpy().mean(0) for method, rows in own.items()}
    counts = {method: len(rows) for method, rows in own.items()}
    figure = _draw(grid, means, counts, styles, {"gid": "progress"})
    (axes,) = figure.axes
    for method, look in styles.items():
        samples = split(own[method].to_numpy(), own[method].index.get_level_values("scenario"))
        low, high = resampled_bounds(samples, mean, resamples)
        band: style.Look = {"color": look.color, "alpha": 0.15, "linewidth": 0}
        axes.fill_between(grid, 100 * low, 100 * high, **band)
    axes.set_xlim(0, grid[-1])
    style.dress(axes, "steps", f"{name} (%)", "both", style.NORMAL)
    return figure


def _draw(
    x: np.ndarray,
    shares: Mapping[str, np.ndarray],
    counts: Mapping[str, int],
    styles: Mapping[str, style.Style],
    look: style.Look,
) -> Figure:
    """Return a figure of one line per method, in percent."""
    figure = style.new_figure(7.0, 4.6)
    axes = figure.subplots()
    axes.set_ylim(0, 103)
    lines = [styles[method].line(axes, x, 100 * shares[method], **look) for method in styles]
    style.legend_above(figure, lines, [f"{name} (n = {counts[name]})" for name in styles])
    return figure
