"""The figures of a run and of a report, and what a report needs of the steps."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from afm_rl.report import comparison, learning, space_plot, style, trajectory
from afm_rl.report.learning import MEASURES, recovery_times
from afm_rl.report.runs import Runs
from afm_rl.report.trajectory import DrawableTrack
from afm_rl.storage.measures import Measures

Ends = tuple[str, str]
"""Of the name and the title of a figure: what it is of."""


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
    yield from _paths(missions, steps, measures, tracks)
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
    # All missions: means, and what was reached by each step.
    measures = runs.measures
    yield _summary(missions, measures)
    goal = measures.headlines[0].title
    caption = (
        f"Progress ({goal}) against the step, mean over all missions of a method, with 95 % "
        "intervals; after its end a mission keeps its value."
    )
    for group, (name, title) in _pages(progress.index.to_frame()):
        figure = comparison.draw_progress(progress, style.method_styles(group["method"]), goal)
        yield Picture(f"progress{name}", f"Progress{title}", caption, style.png_bytes(figure))
    # Single missions, step by step, where methods differ most.
    chosen = missions[missions["scenario"].isin(telling_scenarios(missions, measures))]
    traced = traced_missions(chosen[chosen["file"] >= 0])
    steps = runs.steps(traced) if len(traced) else pd.DataFrame()
    for track, driven in traced.groupby("track", sort=False):
        for group, (name, title) in _pages(driven):
            ends = f"_{track}{name}", f" on {track}{title}"
            yield _learning(group, steps, measures, ends)
            yield from _paths(group, steps, measures, tracks, ends)


def _summary(missions: pd.DataFrame, measures: Measures) -> Picture:
    caption = (
        "Large markers are means over all missions of a method, with 95 % intervals if available; "
        "small dots are single missions."
    )
    figure = comparison.draw_comparison(missions, measures)
    return Picture("summary", "All missions", caption, style.png_bytes(figure))


def _learning(
    missions: pd.DataFrame, steps: pd.DataFrame, measures: Measures, ends: Ends = ("", "")
) -> Picture:
    caption = (
        "One column per scenario, one seed. Rows: distance of the robot after each step from the "
        "plan; from the prediction of model and correction together; from the prediction of the "
        "model (which a frozen model cannot improve); and the model's loss. "
        "Triangles mark where each method's changed regime starts and ends."
    )
    figure = learning.draw_learning(missions, steps, measures.error_unit)
    name, title = f"learning{ends[0]}", f"Errors of plans and predictions{ends[1]}"
    return Picture(name, title, caption, style.png_bytes(figure))


def _paths(
    missions: pd.DataFrame,
    steps: pd.DataFrame,
    measures: Measures,
    tracks: Sequence[DrawableTrack],
    ends: Ends = ("", ""),
) -> Iterator[Picture]:
    """Yield where robots went, on a map or in space, if they have places."""
    if set(space_plot.COLUMNS) <= set(steps):
        name, figure = "space", space_plot.draw_space(missions, steps)
        caption = (
            "One seed: the path and the reference, the error of the height, the first component of "
            "the action (thin: planned; thick: executed), and the distance to the reference. "
            "Crosses and dashed lines mark where a regime begins or ends."
        )
    elif {"x", "y"} <= set(steps):
        name, figure = "trajectory", trajectory.draw_trajectories(missions, steps, measures, tracks)
        caption = (
            "One seed: the path of each robot. The part under the changed regime is broad. If a "
            "robot leaves the road, its path is shown only for a short distance."
        )
    else:
        return
    yield Picture(f"{name}{ends[0]}", f"Paths{ends[1]}", caption, style.png_bytes(figure))


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
    logged, progress = runs.with_steps, runs.measures.progress
    last = logged["steps"].max() + 1 if len(logged) else 1
    grid, times, keys, rows = np.linspace(0, last, points), [], [], []
    columns = [*MEASURES, "regime_active", *(progress or ())[:1]]
    for method, missions in logged.groupby("method", sort=False):
        steps = runs.steps(missions, columns)
        times.append(recovery_times(steps).assign(method=method))
        if progress:
            courses = dict(iter(steps.groupby("mission")))
            ran = missions[missions["mission"].isin(list(courses))].set_index("mission")
            keys += [(method, scenario) for scenario in ran["scenario"]]
            rows += [share_reached(courses[n], each, grid, progress) for n, each in ran.iterrows()]
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


def _pages(missions: pd.DataFrame) -> Iterator[tuple[pd.DataFrame, Ends]]:
    """Yield what each of several figures shows, and the ends of its name and its title.

    >>> [ends for _, ends in _pages(pd.DataFrame({"method": ["a"]}))]
    [('', '')]
    """
    groups = style.groups_of_methods(missions["method"])
    for number, methods in enumerate(groups, 1):
        numbered = f"_{number}", f", page {number} of {len(groups)}"
        group = missions[missions["method"].isin(methods)]
        yield group, numbered if len(groups) > 1 else ("", "")
