"""The figures of a run and of a report, and what a report needs of the steps."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from afm_rl.report import comparison, learning, space_plot, style, trajectory
from afm_rl.report.learning import MEASURES, recovery_times
from afm_rl.report.runs import Runs
from afm_rl.report.trajectory import DrawableTrack
from afm_rl.storage.measures import Measures


class Picture(NamedTuple):
    """A figure as a file."""

    name: str
    title: str
    caption: str
    png: bytes

    @property
    def data(self) -> str:
        """The file as text, for a page."""
        return base64.b64encode(self.png).decode()


def draw_run(
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack] = (),
) -> Iterator[Picture]:
    """Yield the figures of a run: paths, whether plans came true, and all missions."""
    yield from _paths("{}", "Paths", missions, steps, measures, tracks)
    yield _learning(missions, steps, measures)
    if missions["method"].duplicated().any():
        yield _summary(missions, measures)


def draw_report(
    runs: Runs,
    missions: pd.DataFrame,
    progress: pd.DataFrame,
    tracks: Sequence[DrawableTrack] = (),
) -> Iterator[Picture]:
    """Yield the figures of a report, in the order of the page.

    Where there are more than six methods, figures of lines and maps come in several pages.
    """
    measures = runs.measures
    yield _summary(missions, measures)
    chosen = missions[missions["scenario"].isin(telling_scenarios(missions, measures))]
    traced = traced_missions(chosen[chosen["file"] >= 0])
    traces = runs.steps(traced) if len(traced) else pd.DataFrame()
    for track, own in traced.groupby("track", sort=False):
        head = f"How far plans came true on {track}"
        for name, title, methods in _pages(f"learning_{track}", head, own["method"]):
            rows = own[own["method"].isin(methods)]
            yield _learning(rows, traces, measures, name, title)
    if (spent := measures.budget) and missions["finished"].any():
        ratio = comparison.ratios(missions, spent)
        caption = (
            "Performance profile: the share of a method's missions that were finished within tau "
            f"times the fewest {spent.name} that any method (the oracle included) needed for the "
            "same scenario and seed. Where a line starts (tau = 1) says how often the method was "
            "best; how high it ends, how often it finished. Missions that no method finished count "
            "as not solved."
        )
        for name, title, methods in _pages("profile", "Performance profile", missions["method"]):
            figure = comparison.draw_profile(missions, ratio, spent, style.method_styles(methods))
            yield Picture(name, title, caption, style.png_bytes(figure))
    of, known = measures.headlines[0].title, progress.index.get_level_values("method")
    caption = (
        f"Share of what there is to reach ({of}) by a step, mean over all missions of a method; "
        "after its end a mission keeps its share. Higher and further left is better. Bands: 95 % "
        "intervals, seeds drawn anew within scenarios (none where all scenarios have one seed)."
    )
    for name, title, methods in _pages("progress", "Progress", known):
        figure = comparison.draw_progress(progress, style.method_styles(methods), of)
        yield Picture(name, title, caption, style.png_bytes(figure))
    for track, own in traced.groupby("track", sort=False):
        for name, title, methods in _pages(f"{{}}_{track}", f"Paths on {track}", own["method"]):
            rows = own[own["method"].isin(methods)]
            yield from _paths(name, title, rows, traces, measures, tracks)


def _summary(missions: pd.DataFrame, measures: Measures) -> Picture:
    caption = (
        "Large markers are means over all missions of a method, small dots single missions. Lines "
        "are 95 % intervals of the stratified bootstrap, seeds drawn anew within scenarios; a mean "
        "without one has no spread."
    )
    figure = comparison.draw_comparison(missions, measures)
    return Picture("summary", "All missions", caption, style.png_bytes(figure))


def _learning(
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    name: str = "learning",
    title: str = "How far plans came true",
) -> Picture:
    caption = (
        "One column per scenario, one seed. Top: how far the robot was after each step from where "
        "the plan wanted it. Low soon after a change: plans come true again. Second: how far from "
        "where model and correction together predicted it; where a plan cannot be achieved under "
        "the changed regime, this one is low and the first is not. Third: how far from what the "
        "model alone predicts of the executed action; a frozen model under a correction never "
        "improves here. Last: the model's loss; losses of different kinds of model do not compare. "
        "Triangles mark where each method's changed regime starts and ends: the sooner they come, "
        "the faster the method was."
    )
    figure = learning.draw_learning(missions, steps, measures.error_unit)
    return Picture(name, title, caption, style.png_bytes(figure))


def _paths(
    name: str,
    title: str,
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack],
) -> Iterator[Picture]:
    """Yield where robots went, on a map or in space, if they have places."""
    if set(space_plot.COLUMNS) <= set(steps):
        figure = space_plot.draw_space(missions, steps)
        caption = (
            "One seed: the path and the reference, the error of the height, the first component of "
            "the action (thin: planned; thick: executed), and the distance to the reference. "
            "Crosses and dashed lines mark where a regime begins or ends; the stretch under a "
            "changed one is shaded."
        )
        yield Picture(name.format("space"), title, caption, style.png_bytes(figure))
    elif {"x", "y"} <= set(steps):
        figure = trajectory.draw_trajectories(missions, steps, measures, tracks)
        caption = (
            "One seed: the line that each robot drove, methods side by side, scenarios below each "
            "other, and its measures. The stretch under the changed regime is broad. A robot that "
            "leaves the road is followed a little way only."
        )
        yield Picture(name.format("trajectory"), title, caption, style.png_bytes(figure))


def telling_scenarios(missions: pd.DataFrame, measures: Measures, most: int = 4) -> list[str]:
    """Return on each track the scenarios in which methods differ most, by the first measure.

    >>> from afm_rl.storage.measures import Measure
    >>> share = Measures((Measure("share", "share", "share"),))
    >>> rows = {"track": ["oval"] * 2, "method": ["a", "b"], "scenario": ["oval, c"] * 2}
    >>> telling_scenarios(pd.DataFrame(rows | {"share": [0.5, 1.0]}), share)
    ['oval, c']
    """
    column = measures.headlines[0].column
    means = missions.groupby(["track", "scenario", "method"], sort=False)[column].mean()
    spread = means.groupby(["track", "scenario"], sort=False).std().fillna(0.0)
    chosen = spread.sort_values(ascending=False, kind="stable").groupby("track").head(most)
    return [scenario for track, scenario in spread.index if (track, scenario) in chosen.index]


def traced_missions(missions: pd.DataFrame) -> pd.DataFrame:
    """Return one mission per method and scenario: the seed that most methods of the scenario have.

    >>> rows = {"method": ["a", "a", "b"], "scenario": ["oval"] * 3, "seed": [0, 1, 1]}
    >>> traced_missions(pd.DataFrame(rows))["seed"].tolist()
    [1, 1]
    """
    count = missions.groupby(["scenario", "seed"])["method"].nunique().reset_index()
    count = count.sort_values(["method", "seed"], ascending=[False, True])
    chosen = count.drop_duplicates("scenario")[["scenario", "seed"]]
    return missions.merge(chosen, on=["scenario", "seed"])


def read_excerpts(runs: Runs, points: int = 240) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read the steps of each method in turn and keep what a report needs of them.

    Returns:
        Recovery times, with ``method``; and the share of what there is to reach, one row per
        ``method`` and ``scenario`` of a mission (its index), one column per number of steps. There
        are no rows where missions make no progress, or have no steps.
    """
    known, progress = runs.with_steps, runs.measures.progress
    last = known["steps"].max() + 1 if len(known) else 1
    grid, times, keys, rows = np.linspace(0, last, points), [], [], []
    columns = [*MEASURES, "regime_active", *(progress or ())[:1]]
    for method, missions in known.groupby("method", sort=False):
        steps = runs.steps(missions, columns)
        times.append(recovery_times(steps).assign(method=method))
        if progress:
            parts = dict(iter(steps.groupby("mission")))
            own = missions[missions["mission"].isin(list(parts))].set_index("mission")
            keys += [(method, scenario) for scenario in own["scenario"]]
            rows += [share_reached(parts[n], each, grid, progress) for n, each in own.iterrows()]
    index = pd.MultiIndex.from_tuples(keys, names=["method", "scenario"])
    shares = pd.DataFrame(rows, index, grid)
    return pd.concat(times) if times else recovery_times(pd.DataFrame()), shares


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


def _pages(name: str, title: str, methods: Iterable[str]) -> Iterator[tuple[str, str, list[str]]]:
    """Yield name and title of each of several figures, and the methods in it.

    >>> list(_pages("profile", "Profile", ["a"]))
    [('profile', 'Profile', ['a'])]
    """
    groups = style.groups_of_methods(methods)
    for number, group in enumerate(groups, 1):
        numbered = f"{name}_{number}", f"{title}, page {number} of {len(groups)}"
        yield *(numbered if len(groups) > 1 else (name, title)), group
