"""Whether plans came true and models predicted well, and how soon again after a change."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.lib.stride_tricks import sliding_window_view

from afm_rl.report import style
from afm_rl.report.runs import steps_of
from afm_rl.report.tables import Table
from afm_rl.storage.measures import number

STARTS, ENDS = ">", "<"  # markers; together they bracket the stretch
QUANTITIES = {
    "miss": "distance from\nthe plan{units}",
    "unforeseen": "distance from\nthe prediction{units}",
    "error": "model's error{units}",
    "loss": "model's loss\n(NLL)",
}
STAY = 20  # steps that the error must stay low
MEASURES = {"miss": "motion", "unforeseen": "agent", "error": "model"}  # columns: of what


def draw_learning(
    missions: pd.DataFrame, steps: pd.DataFrame, units: str = "", scenarios: int = 4
) -> Figure:
    """Return a figure of errors of plans and predictions against the step.

    Rows: the distance from the plan, from the prediction, the model's error and its loss, as far
    as the steps have them. One column per scenario, first seed and six methods only; the footnote
    names the rest. Triangles mark where each method's changed regime starts and ends. Where
    some missions finish, the axis ends soon after the last of them.

    Args:
        missions: one row per mission.
        steps: one row per mission and step.
        units: units of the model's error.
        scenarios: number of scenarios shown.
    """
    shown, styles, left_out = style.excerpt(missions, scenarios)
    curves, columns = steps_of(steps, shown["mission"]), shown["scenario"].nunique()
    rows = [name for name in QUANTITIES if name in steps and np.isfinite(steps[name]).any()]
    figure = style.new_figure(max(3.4 * columns, 7.2), 1.0 + 1.5 * len(rows))
    grid = figure.subplots(len(rows), columns, sharex="col", sharey="row", squeeze=False)
    for column, (scenario, runs) in zip(grid.T, shown.groupby("scenario", sort=False), strict=True):
        for panel, name in zip(column, rows, strict=True):
            label = QUANTITIES[name].format(units=f"\n({units})" if units else "")
            below = "step" if panel is column[-1] else ""
            style.dress(panel, below, label if panel in grid[:, 0] else "", "y")
            panel.set_xlim(0, last_step(runs))
            for row in runs.itertuples():
                curve, look = curves[row.mission], styles[row.method]
                values = curve[name].where(np.isfinite(curve[name]))
                look.line(panel, curve["t"], values, gid="curve", linewidth=look.width / 2)
                _mark_regime(panel, curve, look)
        column[0].set_title(style.literal(str(scenario)), fontsize=style.NORMAL, pad=8)
    for panels, name in zip(grid, rows, strict=True):
        for panel in panels:
            _scale(panel, name, pd.concat(curves.values())[name])
    faint: style.Look = {"color": style.FAINT, "linestyle": "", "markersize": 6}
    marks = [Line2D([], [], marker=marker, **faint) for marker in (STARTS, ENDS)]
    handles = [*(look.handle() for look in styles.values()), *marks]
    style.legend_above(figure, handles, [*styles, "changed regime starts", "ends"])
    style.footnote(figure, left_out)
    return figure


def last_step(missions: pd.DataFrame, beyond: float = 1.15) -> float:
    """Return where the axis of steps ends: soon after the last mission that finishes.

    >>> last_step(pd.DataFrame({"steps": [400, 5000], "finished": [True, False]}))
    460.0
    >>> last_step(pd.DataFrame({"steps": [400, 430], "finished": [True, False]}))
    430.0
    """
    longest, goal = float(missions["steps"].max()), "finished" in missions
    finished = missions.loc[missions["finished"].astype(bool) if goal else [], "steps"]
    end = longest if finished.empty else round(min(longest, beyond * float(finished.max())))
    return max(1.0, float(end))


def regime_changes(steps: pd.DataFrame) -> tuple[list[int], list[int]]:
    """Return the steps at which the changed regime starts, and those at which it has ended.

    A regime that lasts to the end of the mission has no end.

    >>> steps = pd.DataFrame({"t": range(5), "regime_active": [0, 1, 1, 0, 1]})
    >>> regime_changes(steps)
    ([1, 4], [3])
    """
    active = steps["regime_active"].to_numpy().astype(int)
    change, t = np.diff(active, prepend=0), steps["t"].to_numpy()
    return t[change == 1].tolist(), t[change == -1].tolist()


def _mark_regime(axes: Axes, steps: pd.DataFrame, look: style.Style) -> None:
    """Mark where the changed regime starts and ends."""
    changes, limit = regime_changes(steps), axes.get_xlim()[1]
    top = axes.get_xaxis_transform()  # steps across, 0 to 1 upwards
    for places, marker in zip(changes, (STARTS, ENDS), strict=True):
        seen = [place for place in places if place <= limit]
        if seen:
            across = axes.vlines(seen, 0, 1, color=look.color, linewidth=1.0, transform=top)
            across.set(linestyle=look.linestyle, zorder=1, gid="change")
            (marks,) = axes.plot(seen, [1.0] * len(seen), marker, color=look.color, transform=top)
            marks.set(markersize=6, clip_on=False, gid="change")


def _scale(axes: Axes, name: str, values: pd.Series, linear: float = 10.0) -> None:
    """Give axes a scale that shows these distances (positive), or losses (of either sign)."""
    if name != "loss":
        if (values > 0).any():
            axes.set_yscale("log", nonpositive="mask", subs=[])  # minor ticks take a third of it
    elif (values[np.isfinite(values)].abs() > linear).any():
        axes.set_yscale("symlog", linthresh=linear)


def recovery_times(steps: pd.DataFrame) -> pd.DataFrame:
    """Return one row per change and measure: ``of``, ``change`` (from 1) and ``time``.

    That is the steps until the error stays under the nominal level: 0 where it never left, inf
    where it does not happen until the next change or the end.
    Changes that are too near to those are left out, and so is a mission that changes at once: it
    shows no nominal level.

    Args:
        steps: of one mission, in order, or of several, one after the other, told apart by their
            number ``mission``; a column that is missing is left out.

    >>> active, error = [0] * 30 + [1] * 50, [1e-3] * 30 + [1] * 7 + [1e-3] * 43
    >>> steps = pd.DataFrame({"regime_active": active, "error": error})
    >>> recovery_times(steps).to_dict("records")
    [{'of': 'model', 'change': 1, 'time': 7.0}]
    """
    active = steps["regime_active"].to_numpy() if len(steps) else np.zeros(0)
    errors = {
        of: steps[name].to_numpy(dtype=float) for name, of in MEASURES.items() if name in steps
    }
    number = steps["mission"].to_numpy() if "mission" in steps else np.zeros(len(active))
    borders, rows = [0, *np.flatnonzero(np.diff(number)) + 1, len(active)], []
    for begin, end in pairwise(borders):
        changes = np.flatnonzero(np.diff(active[begin:end])) + 1
        for of, error in errors.items():
            if len(changes) and not np.isnan(error[begin:end]).any():
                rows += [(of, *row) for row in _times(error[begin:end], changes)]
    table = pd.DataFrame(rows, columns=["of", "change", "time"])
    return table.astype({"change": int, "time": float})  # also without rows: tables are joined


def _times(
    error: np.ndarray, changes: np.ndarray, factor: float = 1.5, floor: float = 1e-4
) -> list[tuple[int, float]]:
    """Return changes, from 1, and the steps until the error stays low."""
    level = max(floor, factor * float(np.quantile(error[: changes[0]], 0.95)))
    times = []
    for count, (start, end) in enumerate(zip(changes, [*changes[1:], len(error)], strict=True)):
        if end - start >= STAY:
            stays = sliding_window_view(error[start:end] <= level, STAY).all(-1)
            times.append((count + 1, float(stays.argmax()) if stays.any() else np.inf))
    return times


def recovery_table(times: pd.DataFrame) -> Table:
    """Return medians per method, measure and change."""

    def share(of: float) -> object:
        return lambda steps: steps.quantile(of, interpolation="lower")

    by = times.groupby(["method", "of", "change"], sort=False)
    numbers = by.agg(
        changes=("time", "size"),
        median=("time", share(0.5)),
        lower_quartile=("time", share(0.25)),
        upper_quartile=("time", share(0.75)),
        never=("time", lambda steps: float(np.isinf(steps).mean())),
    ).reset_index()
    low, high = (numbers[f"{end}_quartile"].map(number) for end in ("lower", "upper"))
    heads = {
        "method": numbers["method"],
        "of the": numbers["of"],
        "change": numbers["change"].astype(str),
        "changes seen": numbers["changes"].astype(str),
        "median steps": numbers["median"].map(number),
        "quartiles": low + " to " + high,
        "never %": (100 * numbers["never"]).map(number),
    }
    note = (
        f"Steps from a change of the regime until the one-step error stays under the nominal level "
        f"for {STAY} steps: 1.5 times the 95th percentile before the first change, at least "
        "0.0001. Medians are over all changes, with ∞ for changes without recovery; changes "
        f"with fewer than {STAY} steps to the next one or to the end are excluded. The error of "
        "the motion is against the plan, that of the agent against the prediction of model and "
        "correction together, that of the model against its prediction for the executed action."
    )
    title = "Recovery after each change of the regime"
    return Table("recovery", title, note, numbers, pd.DataFrame(heads))
