"""Performance profiles."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from afm_rl.report import style

CAPTION = (
    "Performance profile: the share of a method's missions that were finished in at most tau "
    "times the fewest steps that any method (the oracle included) needed for the same cell and "
    "seed. Where a line starts (tau = 1) says how often the method was the fastest; how high it "
    "ends, how often it finished. Missions that nobody finished count as not solved. The legend "
    "says how many missions each method has."
)
WIDEST = 20.0  # tau at most


def ratios(missions: pd.DataFrame) -> pd.Series:
    """Return each mission's steps over the fewest of its cell and seed; inf if not finished.

    >>> rows = {"cell": "a", "seed": 0, "steps": [199, 99, 99], "finished": [True, True, False]}
    >>> ratios(pd.DataFrame(rows)).tolist()
    [2.0, 1.0, inf]
    """
    made = (missions["steps"] + 1.0).where(missions["finished"], np.inf)
    fewest = made.groupby([missions["cell"], missions["seed"]]).transform("min")
    return (made / fewest).fillna(np.inf)


def draw_profile(missions: pd.DataFrame, styles: dict[str, style.Style]) -> Figure:
    """Return a figure of the share of missions within a factor of the fewest steps.

    Args:
        missions: one row per mission, with ``cell``.
        styles: how each method is drawn.
    """
    ratio = ratios(missions)
    finite = ratio[np.isfinite(ratio)]
    limit = float(np.clip(finite.max() if len(finite) else 2.0, 2.0, WIDEST))
    figure = style.new_figure(7.0, 4.6)
    axes = figure.subplots()
    handles: list[Line2D] = []
    labels = []
    for method, own in ratio.groupby(missions["method"], sort=False):
        look, count = styles[str(method)], len(own)
        taus = np.geomspace(1.0, limit, 200)
        share = 100 * np.searchsorted(np.sort(own), taus * (1 + 1e-9), side="right") / count
        (line,) = axes.plot(taus, share, color=look.color, linewidth=1.5, drawstyle="steps-post")
        line.set(linestyle=look.linestyle, marker=look.marker, markersize=5.0, gid="profile")
        line.set(markevery=(5 * len(handles) % 22, 22), clip_on=False, markeredgecolor="white")
        line.set(markeredgewidth=0.5)
        handles.append(line)
        labels.append(f"{method} (n = {count})")
    axes.set_xscale("log")
    axes.set_xlim(1.0, limit)
    axes.set_ylim(0, 103)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda tau, _: f"{tau:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("tau: steps / fewest steps of any method", fontsize=style.NORMAL)
    axes.set_ylabel("missions finished within tau (%)", fontsize=style.NORMAL)
    axes.grid(color="#eeeeee", linewidth=0.6)
    style.dress(axes)
    style.legend_above(figure, handles, labels)
    return figure
