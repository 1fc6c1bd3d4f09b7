"""The figures of a report, and what they and the recovery table need of the steps."""

from __future__ import annotations

from collections.abc import Collection as AnyOf
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from afm_rl.report import comparison, heatmaps, learning, shares, space_plot, style
from afm_rl.report.collect import Collection
from afm_rl.report.recovery import MEASURES, recovery_times
from afm_rl.report.results_files import read_steps
from afm_rl.report.track_plot import DrawableTrack
from afm_rl.storage.measures import Measures

CELLS = 4  # of a track: curves and maps of more say less
POINTS = 240  # of each curve of progress


@dataclass
class Excerpts:
    """Excerpts of the steps of all methods.

    Attributes:
        grid: numbers of steps ``(G,)`` at which progress is known.
        recovery: recovery times, with ``method``, ``cell``, ``seed``.
        progress: per method, the share of what there is to reach by then, ``(B, G)``, one row per
            mission; methods without steps are not here.
        cells: per method, the cells of these missions, ``(B,)``.
        places: where robots were (m), ``(N, 2)``, by cell and method.
    """

    grid: np.ndarray
    recovery: list[pd.DataFrame] = field(default_factory=list)
    progress: dict[str, np.ndarray] = field(default_factory=dict)
    cells: dict[str, pd.Series] = field(default_factory=dict)
    places: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)


def telling_cells(missions: pd.DataFrame, measures: Measures) -> list[str]:
    """Return on each track the cells in which methods differ most, by the first measure.

    >>> from afm_rl.storage.measures import Measure
    >>> share = Measures((Measure("share", "share", "share"),))
    >>> rows = {"track": ["oval"] * 2, "method": ["a", "b"], "cell": ["oval, c"] * 2}
    >>> telling_cells(pd.DataFrame(rows | {"share": [0.5, 1.0]}), share)
    ['oval, c']
    """
    column = measures.headlines[0].column
    means = missions.groupby(["track", "cell", "method"], sort=False)[column].mean()
    spread = means.groupby(["track", "cell"], sort=False).std().fillna(0.0)
    chosen = spread.sort_values(ascending=False, kind="stable").groupby("track").head(CELLS)
    return [cell for track, cell in spread.index if (track, cell) in chosen.index]


def traced_missions(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one mission per method and cell: the seed that most methods of the cell have.

    >>> rows = {"method": ["a", "a", "b"], "cell": ["oval"] * 3, "seed": [0, 1, 1]}
    >>> traced_missions(pd.DataFrame(rows))["seed"].tolist()
    [1, 1]
    """
    count = missions.groupby(["cell", "seed"])["method"].nunique().reset_index()
    count = count.sort_values(["method", "seed"], ascending=[False, True])
    chosen = count.drop_duplicates("cell")[["cell", "seed"]]
    return missions.merge(chosen, on=["cell", "seed"])


def excerpts(collection: Collection, mapped: AnyOf[str]) -> Excerpts:
    """Read the steps of each method in turn and keep excerpts.

    Args:
        collection: the results.
        mapped: cells to keep places of.
    """
    known = collection.missions[collection.missions["file"] >= 0]
    last = known["steps"].max() + 1 if len(known) else 1
    found, progress = Excerpts(np.linspace(0, last, POINTS)), collection.measures.progress
    columns = [*MEASURES, "regime_active", "x", "y", *(progress or ())[:1]]
    for method, missions in known.groupby("method", sort=False):
        steps = dict(iter(read_steps(collection.files, missions, columns).groupby("mission")))
        own = missions[missions["mission"].isin(list(steps))]
        places: dict[str, list[np.ndarray]] = {}
        for mission in own.to_dict("records"):
            rows = steps[mission["mission"]]
            named = {name: mission[name] for name in ("method", "cell", "seed")}
            found.recovery.append(recovery_times(rows).assign(**named))
            where = rows[["x", "y"]].to_numpy(dtype=float)
            where = where[np.isfinite(where).all(-1)]
            if mission["cell"] in mapped and len(where):
                places.setdefault(mission["cell"], []).append(where)
        if progress and len(own):
            each = own.set_index("mission").iterrows()
            lines = [share_reached(steps[n], row, found.grid, progress) for n, row in each]
            found.progress[str(method)], found.cells[str(method)] = np.array(lines), own["cell"]
        for cell, parts in places.items():
            found.places[cell, str(method)] = np.concatenate(parts)
    return found


def share_reached(
    steps: pd.DataFrame, mission: pd.Series, grid: np.ndarray, progress: tuple[str, str]
) -> np.ndarray:
    """Return the share of what there is to reach once ``grid`` ``(G,)`` steps have been made.

    After the mission's last step the share stays what it was at its end.

    >>> steps = pd.DataFrame({"t": [0, 1, 2], "got": [0, 0, 1]})
    >>> mission, grid = pd.Series({"got": 2, "all": 2}), np.array([0, 2, 3, 9])
    >>> share_reached(steps, mission, grid, ("got", "all"))
    array([0. , 0.5, 1. , 1. ])
    """
    column, total = progress
    place = np.searchsorted(steps["t"], grid, side="right") - 1
    reached = steps[column].to_numpy(dtype=float)[np.maximum(place, 0)]
    reached[grid > steps["t"].iloc[-1]] = mission.get(column, reached[-1])
    return reached / mission[total]


def draw_all(
    missions: pd.DataFrame,
    collection: Collection,
    found: Excerpts,
    tracks: list[DrawableTrack],
) -> Iterator[tuple[str, str, str, Figure]]:
    """Yield name, title, caption and figure, in the order of the page.

    Where there are more than six methods, figures of lines and maps come in several pages.

    Args:
        missions: one row per mission, from :func:`~afm_rl.report.summary.count_budgets`.
        collection: the results.
        found: from :func:`excerpts`.
        tracks: tracks to draw; a map whose track is not here has no road.
    """
    measures, known = collection.measures, {track.name: track for track in tracks}
    figure = comparison.draw_comparison(missions, measures)
    yield "summary", "All missions", comparison.CAPTION, figure
    chosen = missions[missions["cell"].isin(telling_cells(missions, measures))]
    traced = traced_missions(chosen[chosen["file"] >= 0])
    traces = read_steps(collection.files, traced) if len(traced) else pd.DataFrame()
    space = set(space_plot.COLUMNS) <= set(traces)
    for track, own in traced.groupby("track", sort=False):
        for page, methods in _pages(
            f"learning_{track}", f"How far plans came true on {track}", own
        ):
            rows = own[own["method"].isin(methods)]
            figure = learning.draw_learning(rows, traces, measures.error_unit)
            yield *page, learning.CAPTION, figure
    if (spent := measures.budget) and missions["finished"].any():
        ratio, caption = shares.ratios(missions, spent), shares.PROFILE_CAPTION
        for page, methods in _pages("profile", "Performance profile", missions):
            figure = shares.draw_profile(missions, ratio, spent, style.method_styles(methods))
            yield *page, caption.format(name=spent.name), figure
    name, known_missions = measures.headlines[0].title, missions[missions["file"] >= 0]
    for page, methods in _pages("progress", "Progress", known_missions) if found.progress else ():
        styles = style.method_styles(methods)
        figure = shares.draw_progress(found.grid, found.progress, found.cells, styles, name)
        yield *page, shares.PROGRESS_CAPTION.format(name=name), figure
    for track, own in missions.groupby("track", sort=False):
        places = {key: found.places[key] for key in found.places if key[0] in set(own["cell"])}
        for page, methods in _pages(f"space_{track}", f"Paths on {track}", own) if space else ():
            rows = traced[(traced["track"] == track) & traced["method"].isin(methods)]
            yield *page, space_plot.CAPTION, space_plot.draw_space(rows, traces)
        if places and not space:
            drawn = heatmaps.draw_heatmaps(places, known.get(str(track)))
            pages = _pages(f"heat_{track}", f"Places on {track}", [m for _, m in places])
            for (page, _), figure in zip(pages, drawn, strict=True):
                yield *page, heatmaps.CAPTION.format(track=track), figure


def _pages(
    name: str, title: str, missions: pd.DataFrame | list[str]
) -> Iterator[tuple[tuple[str, str], list[str]]]:
    """Yield name and title of each of several figures, and the methods in it.

    >>> list(_pages("profile", "Profile", ["a"]))
    [(('profile', 'Profile'), ['a'])]
    """
    methods = missions["method"] if isinstance(missions, pd.DataFrame) else missions
    groups = style.groups_of_methods(methods)
    for number, group in enumerate(groups, 1):
        one = (name, title)
        some = (f"{name}_{number}", f"{title}, page {number} of {len(groups)}")
        yield (some if len(groups) > 1 else one), group
