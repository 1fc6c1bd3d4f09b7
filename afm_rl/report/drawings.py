"""All figures of a report on joined results."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure

from afm_rl.dynamics import Dubins
from afm_rl.errors import ConfigurationError
from afm_rl.report import bars, feasible, profile, progress, style
from afm_rl.report.gather import Gathered
from afm_rl.report.heatmaps import heat_figures
from afm_rl.report.road import DrawableTrack
from afm_rl.report.scenarios import scenario_figures

UGV_GAINS = {"v_gain", "omega_gain"}
LoadTrack = Callable[[str], DrawableTrack]


def all_figures(
    missions: pd.DataFrame,
    means: pd.DataFrame,
    traced: pd.DataFrame,
    gathered: Gathered,
    load_track: LoadTrack | None,
) -> Iterator[tuple[str, str, str, Figure]]:
    """Yield name, title, caption and figure, in the order of the page.

    Args:
        missions: from :func:`~afm_rl.report.outcomes.add_outcomes`.
        means: from :func:`~afm_rl.report.aggregate.aggregate`.
        traced: from :func:`~afm_rl.report.scenarios.traced_missions`.
        gathered: from :func:`~afm_rl.report.gather.gather`.
        load_track: returns a track by name; a map whose track cannot be loaded has no road.
    """
    styles = style.method_styles(missions["method"])
    yield "aggregate", "All missions", bars.CAPTION, bars.draw_bars(means, styles)
    yield "profile", "Performance profile", profile.CAPTION, profile.draw_profile(missions, styles)
    if gathered.progress:
        figure = progress.draw_progress(gathered, styles)
        yield "progress", "Targets reached by a step", progress.CAPTION, figure
    if gathered.traces:
        steps = pd.concat(gathered.traces, ignore_index=True)
        yield from scenario_figures(traced, steps, styles)
    tracks = load_tracks(missions["track"].unique(), load_track)
    yield from heat_figures(missions, gathered.places, tracks)
    if set(missions.columns) >= UGV_GAINS:
        yield "feasible", "Feasible dynamics", feasible.CAPTION, _feasible()


def _feasible() -> Figure:
    angle = torch.tensor([0.0, 0.0, torch.pi])
    action = torch.tensor([1.0, torch.pi / 2])
    return feasible.draw_feasible(Dubins(), (-angle, angle), (-action, action))


def load_tracks(names: np.ndarray, load_track: LoadTrack | None) -> list[DrawableTrack]:
    """Return the tracks that can be loaded; a map without its road is a map."""
    tracks = []
    for name in names if load_track else ():
        try:
            tracks.append(load_track(str(name)))  # type: ignore[misc]
        except ConfigurationError:
            continue
    return tracks
