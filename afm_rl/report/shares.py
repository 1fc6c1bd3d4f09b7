"""Shares of missions and of targets: performance profiles, and progress against the step."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from afm_rl.report import style
from afm_rl.report.statistics import resampled_bounds, split
from afm_rl.storage.measures import Measure

PROFILE_CAPTION = (
    "Performance profile: the share of a method's missions that were finished within tau times the "
    "fewest {name} that any method (the oracle included) needed for the same cell and seed. Where "
    "a line starts (tau = 1) says how often the method was best; how high it ends, how often it "
    "finished. Missions that no method finished count as not solved."
)
PROGRESS_CAPTION = (
    "Share of what there is to reach ({name}) by a step, mean over all missions of a method; after "
    "its end a mission keeps its share. Higher and further left is better. Bands: 95 % intervals, "
    "seeds drawn anew within cells (none where all cells have one seed)."
)
WIDEST = 20.0  # tau at most
RESAMPLES = 500  # the band is as wide as a line: no need for more


def ratios(missions: pd.DataFrame, spent: Measure) -> pd.Series:
    """Return what each mission spent over the least of its cell and seed; inf if not finished.

    >>> steps = Measure("steps", "steps", "steps", budget=True)
    >>> rows = {"cell": "a", "seed": 0, "steps": [199, 99, 99], "finished": [True, True, False]}
    >>> ratios(pd.DataFrame(rows), steps).tolist()
    [2.0, 1.0, inf]
    """
    made = (missions[spent.column] + 1.0).where(missions["finished"].astype(bool), np.inf)
    fewest = made.groupby([missions["cell"], missions["seed"]]).transform("min")
    return (made / fewest).fillna(np.inf)


def draw_profile(
    missions: pd.DataFrame, ratio: pd.Series, spent: Measure, styles: Mapping[str, style.Style]
) -> Figure:
    """Return a figure of the share of missions within a factor of the least.

    Args:
        missions: one row per mission, with ``cell``.
        ratio: from :func:`ratios`, of all methods.
        spent: what missions spend.
        styles: the methods to draw, and how.
    """
    finite = ratio[np.isfinite(ratio)]
    limit = float(np.clip(finite.max() if len(finite) else 2.0, 2.0, WIDEST))
    figure, axes = _axes(f"tau: {spent.name} / fewest {spent.name} of any method")
    taus, lines = np.geomspace(1.0, limit, 200), {}
    for method, look in styles.items():
        own = ratio[missions["method"] == method]
        share = 100 * np.searchsorted(np.sort(own), taus * (1 + 1e-9), side="right") / len(own)
        line = look.line(axes, taus, share, gid="profile", drawstyle="steps-post", clip_on=False)
        lines[f"{method} (n = {len(own)})"] = line
    axes.set(xscale="log", xlim=(1.0, limit))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda tau, _: f"{tau:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("missions finished within tau (%)", fontsize=style.NORMAL)
    style.legend_above(figure, list(lines.values()), list(lines))
    return figure


def draw_progress(
    grid: np.ndarray,
    shares: Mapping[str, np.ndarray],
    cells: Mapping[str, pd.Series],
    styles: Mapping[str, style.Style],
    name: str,
) -> Figure:
    """Return a figure of the mean share of what was reached against the number of steps.

    Args:
        grid: numbers of steps ``(G,)``.
        shares: per method, ``(B, G)``, one row per mission.
        cells: per method, the cell of each mission, ``(B,)``.
        styles: the methods to draw, and how.
        name: what is reached.
    """
    figure, axes = _axes("steps")
    lines = {}
    for method, look in styles.items():
        samples = split(shares[method], cells[method])
        bounds = resampled_bounds(samples, _mean, RESAMPLES)
        axes.fill_between(grid, *(100 * bounds), color=look.color, alpha=0.15, linewidth=0)
        line = look.line(axes, grid, 100 * shares[method].mean(0), gid="progress")
        lines[f"{method} (n = {len(shares[method])})"] = line
    axes.set_xlim(0, grid[-1])
    axes.set_ylabel(f"{name} (%)", fontsize=style.NORMAL)
    style.legend_above(figure, list(lines.values()), list(lines))
    return figure


def _mean(samples: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(samples, -1).mean(-1)


def _axes(label: str) -> tuple[Figure, Axes]:
    figure = style.new_figure(7.0, 4.6)
    axes = figure.subplots()
    axes.set_ylim(0, 103)
    axes.set_xlabel(label, fontsize=style.NORMAL)
    style.grid(axes)
    style.dress(axes)
    return figure, axes
