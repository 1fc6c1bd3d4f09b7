"""What a report says of flights."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from afm_rl.report.collect import Collection
from afm_rl.report.comparison import draw_comparison
from afm_rl.report.flight import CELLS, COLUMNS, draw_flight
from afm_rl.report.frames import first_missions
from afm_rl.report.kinds import FLIGHTS
from afm_rl.report.results_files import read_steps
from afm_rl.report.summary import summarise, summarise_cells
from afm_rl.report.table import Table, best_places, number, with_interval

NOTE = (
    "Means over flights; the squared error is the mean over time and axes. Brackets are 95 % "
    "bootstrap intervals. Bold: the best value, the oracle included."
)
CELL_NOTE = "Mean squared error (m²) of each method in each cell. Bold: the smallest of a cell."
CAPTIONS = {
    "summary": "Large markers are means with 95 % bootstrap intervals, small dots single flights.",
    "flight": f"The first seed in the first {CELLS} cells. Thin: planned thrust; thick: executed.",
}


def flight_tables(missions: pd.DataFrame) -> Iterator[Table]:
    """Yield the tables: methods, and cells x methods.

    Args:
        missions: one row per flight; times may be left out.
    """
    yield _methods(summarise(_timed(missions)))
    yield _cells(summarise_cells(_timed(missions)))


def _timed(missions: pd.DataFrame) -> pd.DataFrame:
    """Return missions with times; a study's table has none."""
    return missions if "seconds" in missions else missions.assign(seconds=np.nan)


def _methods(means: pd.DataFrame) -> Table:
    rows = []
    for row in means.to_dict("records"):
        shown = {"method": row["method"], "flights": str(row["missions"])}
        shown["finished %"] = number(100 * row["finished"])
        for each in FLIGHTS.measures:
            mean, low, high = (row[each.name + end] for end in ("", "_low", "_high"))
            shown[each.head] = with_interval(mean, low, high, each.digits)
        rows.append(shown)
    names = [each.name for each in FLIGHTS.measures]
    bold = best_places(
        means, dict.fromkeys(names, "min"), {name: 3 + k for k, name in enumerate(names)}
    )
    shown = pd.DataFrame(rows)
    return Table("aggregate", "All flights of each method", NOTE, means, shown, bold)


def _cells(means: pd.DataFrame) -> Table:
    methods, rows, bold = list(means["method"].unique()), [], set()
    for place, (cell, group) in enumerate(means.groupby("cell", sort=False)):
        found = {row["method"]: row for row in group.to_dict("records")}
        texts = {name: FLIGHTS.cell(row) for name, row in found.items()}
        rows.append({"cell": cell} | {name: texts.get(name, "-") for name in methods})
        best = max(FLIGHTS.rank(row) for row in found.values())
        if len(found) > 1:
            bold |= {(place, 1 + methods.index(m)) for m in found if FLIGHTS.rank(found[m]) == best}
    shown = pd.DataFrame(rows)
    return Table("cells", "Flights, cell by cell", CELL_NOTE, means, shown, frozenset(bold))


def flight_figures(collection: Collection) -> Iterator[tuple[str, str, str, Figure]]:
    """Yield name, title, caption and figure, in the order of the page.

    Args:
        collection: results of flights.
    """
    missions = collection.missions
    yield "summary", "All flights", CAPTIONS["summary"], draw_comparison(_timed(missions))
    known = first_missions(missions[missions["file"] >= 0])
    shown = known[known["cell"].isin(known["cell"].unique()[:CELLS])]
    if len(shown):
        steps = read_steps(collection.files, shown, COLUMNS)
        yield "flight", "Flights", CAPTIONS["flight"], draw_flight(shown, steps)
