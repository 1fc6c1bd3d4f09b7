"""The paper's figures, drawn from the folder of our study: three PNG files.

    python examples/paper/published_figures.py outputs/study/ugv_paper

* ``paper_loss``: the model's loss against the step, one panel per track: means over all missions
  of a method that are still on their way, moving average of 20. Vertical lines are at the mean
  steps at which the dynamics change.
* ``paper_paths``: paths under one regime (``--regime``), a row per track: means over seeds at equal
  shares of each mission, moving average of 14, as a ribbon of 0.2 standard deviations to each side,
  coloured by the share of the budget that has passed.
* ``paper_bars``: success and steps, a row per track: means over regimes and seeds with the standard
  deviation over seeds, beside the published means, which are hollow.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from published_tables import LABELS, MEASURES, published

from afm_rl.envs import load_track
from afm_rl.report import read_runs, style
from afm_rl.report.learning import regime_changes
from afm_rl.report.runs import Runs
from afm_rl.report.trajectory import draw_road, load_tracks, positions, view
from afm_rl.storage.files import write_whole

LOSS_WINDOW, PATH_WINDOW, SHARE, POINTS = 20, 14, 0.2, 400
COLUMNS = ["x", "y", "loss", "regime_active"]


def mean_loss(steps: pd.DataFrame, missions: pd.DataFrame) -> pd.DataFrame:
    """Return the moving average ``(T, methods)`` of the mean loss of each method at each step."""
    joined = steps.merge(missions[["mission", "method"]], on="mission")
    joined = joined[np.isfinite(joined["loss"])]
    means = joined.pivot_table(index="t", columns="method", values="loss", aggfunc="mean")
    return means.rolling(LOSS_WINDOW, min_periods=1).mean()


def change_steps(steps: pd.DataFrame) -> tuple[float, float]:
    """Return the mean steps at which the dynamics change, and change back; NaN where none do."""
    changes = [regime_changes(rows) for _, rows in steps.groupby("mission")]
    both = [[ends[0] for ends in part if ends] for part in zip(*changes, strict=True)]
    starts, ends = (float(np.mean(part)) if part else np.nan for part in both)
    return starts, ends


def mean_path(paths: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation ``(P, 2)`` of paths ``(N, 2)`` at equal shares of each."""
    share = np.linspace(0, 1, POINTS)
    places = [np.linspace(0, 1, len(path)) for path in paths]
    even = [
        np.stack([np.interp(share, place, column) for column in path.T], -1)
        for place, path in zip(places, paths, strict=True)
    ]

    def smooth(values: np.ndarray) -> np.ndarray:
        return pd.DataFrame(values).rolling(PATH_WINDOW, 1, center=True).mean().to_numpy()

    return smooth(np.mean(even, 0)), smooth(np.std(even, 0))


def draw_losses(runs: Runs) -> Figure:
    """Return the loss of each method that has one, a panel per track."""
    tracks = list(runs.with_steps.groupby("track", sort=True))
    figure, looks = style.new_figure(5.5 * len(tracks), 3.4), style.method_styles(runs.methods)
    panels, drawn = figure.subplots(1, len(tracks), sharey=True, squeeze=False)[0], {}
    for panel, (track, missions) in zip(panels, tracks, strict=True):
        steps = runs.steps(missions, COLUMNS)
        style.dress(panel, "step", "loss (NLL)" if panel is panels[0] else "", "y")
        panel.set_title(track, fontsize=style.NORMAL)
        panel.set_yscale("symlog", linthresh=10)
        for method, curve in mean_loss(steps, missions).items():
            look = looks[str(method)]
            drawn[str(method)] = look.handle()
            look.line(panel, curve.index, curve, gid="loss", linewidth=1.2)
            own = missions.loc[missions["method"] == method, "mission"]
            for step in change_steps(steps[steps["mission"].isin(own)]):
                panel.axvline(step, color=look.color, linewidth=0.8, linestyle=":")
    style.legend_above(figure, list(drawn.values()), list(drawn))
    return figure


def draw_paths(runs: Runs, regime: tuple[float, float]) -> Figure:
    """Return the mean paths under one regime, a row per track and a column per method."""
    gains = runs.missions[["v_gain", "omega_gain"]]
    chosen = runs.missions[np.isclose(gains, regime).all(1) & (runs.missions["file"] >= 0)]
    if chosen.empty:
        raise SystemExit(f"--regime {regime}: no mission with steps; there are {gains.values}")
    methods, tracks = list(chosen["method"].unique()), sorted(chosen["track"].unique())
    roads = {road.name: road for road in load_tracks(tracks, load_track)}
    figure = style.new_figure(2.3 * len(methods), 2.5 * len(tracks))
    grid = figure.subplots(len(tracks), len(methods), sharex="row", sharey="row", squeeze=False)
    budget = Normalize(0, float(chosen["steps"].max()))
    for row, track in zip(grid, tracks, strict=True):
        for panel, method in zip(row, methods, strict=True):
            own = chosen[(chosen["track"] == track) & (chosen["method"] == method)]
            paths = [positions(rows) for _, rows in runs.steps(own, ["x", "y"]).groupby("mission")]
            panel.set_axis_off()
            panel.set_aspect("equal")
            if panel in grid[0]:
                panel.set_title(method, fontsize=style.NORMAL)
            road = roads.get(track)
            if road is not None:
                draw_road(panel, road)
            box = view(road, paths or [np.zeros((1, 2))])
            panel.set(xlim=box.intervalx, ylim=box.intervaly)
            if paths:
                mean, std = mean_path(paths)
                _ribbon(panel, mean, SHARE * std, budget, float(own["steps"].mean()))
    bar = figure.colorbar(ScalarMappable(budget, "viridis"), ax=grid, shrink=0.6)
    bar.set_label("step", fontsize=style.SMALL)
    return figure


def _ribbon(panel, mean: np.ndarray, half: np.ndarray, budget: Normalize, last: float) -> None:
    """Draw a path with its deviation to both sides, coloured by the step."""
    along = np.gradient(mean, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True).clip(1e-9)
    aside = np.stack([-along[:, 1], along[:, 0]], 1)
    width = aside * np.abs((aside * half).sum(1, keepdims=True))
    left, right = mean + width, mean - width
    quads = np.stack([left[:-1], left[1:], right[1:], right[:-1]], 1)
    colour = np.linspace(0, last, len(mean) - 1)
    look = {"array": colour, "norm": budget, "cmap": "viridis"}
    panel.add_collection(PolyCollection(quads, alpha=0.4, linewidths=0, **look))
    panel.add_collection(LineCollection(np.stack([mean[:-1], mean[1:]], 1), linewidths=1.4, **look))


def draw_bars(runs: Runs) -> Figure:
    """Return success and steps of each method beside the published ones, a row per track."""
    methods, tracks = runs.methods, sorted(runs.missions["track"].unique())
    figure, looks = style.new_figure(9.0, 2.4 * len(tracks)), style.method_styles(methods)
    grid, place = figure.subplots(len(tracks), 2, squeeze=False), np.arange(len(methods))
    for row, track in zip(grid, tracks, strict=True):
        printed = published()[lambda rows, track=track: rows["track"] == track]
        own = runs.missions[runs.missions["track"] == track]
        for panel, (measure, column) in zip(row, MEASURES.items(), strict=True):
            seeds = own.groupby(["method", "seed"])[column].mean().groupby("method")
            means, stds = seeds.mean().reindex(methods), seeds.std(ddof=0).reindex(methods)
            theirs = printed.groupby("method")[f"{measure}_mean"].mean()
            theirs = theirs.reindex([LABELS.get(name) for name in methods])
            colours = [looks[name].color for name in methods]
            panel.bar(place - 0.2, means, 0.38, yerr=stds, color=colours, error_kw={"lw": 1})
            panel.bar(place + 0.2, theirs, 0.38, facecolor="white", edgecolor=colours, hatch="///")
            style.dress(panel, "", f"{measure}, {track}", "y")
            panel.set_xticks(place, methods, rotation=30, ha="right", fontsize=style.SMALL)
    style.footnote(figure, "filled: ours; hatched: as published, where the paper has the method")
    return figure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="results of runs or studies")
    parser.add_argument("--out", type=Path, help="where to (FOLDER/report/figures, of the first)")
    parser.add_argument("--regime", nargs=2, type=float, default=(1.0, -1.0), metavar="GAIN")
    options = parser.parse_args()
    read, out = read_runs(options.folders), options.out
    out = out or options.folders[0] / "report" / "figures"
    figures = {"loss": draw_losses(read), "bars": draw_bars(read)}
    figures["paths"] = draw_paths(read, tuple(options.regime))
    for name, figure in figures.items():
        write_whole(out / f"paper_{name}.png", style.png_bytes(figure))
        print(out / f"paper_{name}.png")
