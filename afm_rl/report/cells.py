"""Every method in every cell."""

from __future__ import annotations

import pandas as pd

from afm_rl.report.table import Table

NOTE = (
    "Mean share of targets reached (%) / mean number of steps; a mission that was given up counts "
    "with its budget. Bold: the highest success of a cell and, among equals, the fewest steps."
)
MEANS = {
    "missions": ("cost", "size"),
    "success": ("success_rate", "mean"),
    "steps": ("cost", "mean"),
}


def cell_table(missions: pd.DataFrame) -> Table:
    """Return the means of each method (a column) in each cell (a row).

    Args:
        missions: from :func:`~afm_rl.report.outcomes.add_outcomes`.
    """
    numbers = missions.groupby(["cell", "method"], sort=False).agg(**MEANS).reset_index()
    methods = list(missions["method"].unique())
    rows, bold = [], set()
    for place, (cell, group) in enumerate(numbers.groupby("cell", sort=False)):
        texts = {
            row.method: f"{100 * row.success:.0f} / {row.steps:.0f}" for row in group.itertuples()
        }
        rows.append({"cell": cell} | {method: texts.get(method, "-") for method in methods})
        rank = {row.method: (row.success, -row.steps) for row in group.itertuples()}
        if len(set(rank.values())) > 1:
            best = max(rank.values())
            bold |= {(place, methods.index(name) + 1) for name in rank if rank[name] == best}
    shown = pd.DataFrame(rows)
    return Table("cells", "Success and steps, cell by cell", NOTE, numbers, shown, frozenset(bold))
