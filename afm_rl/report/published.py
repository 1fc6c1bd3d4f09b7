"""Our means beside those that the paper printed."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from afm_rl.report.frames import short_cell_names
from afm_rl.report.table import Table

FIGURES = Path(__file__).with_name("published.csv")
OURS = {  # the paper's name: our label
    "afm": "afm_paper",
    "online_pe": "online_pe",
    "stream_x_pe": "stream_x_pe",
    "physics": "physics",
    "frozen_pe": "frozen_pe",
}
DIGITS = {"success": 2, "steps": 0}
NOTE = (
    "Mean ± standard deviation over the seeds of one regime on {track}: ours, then as published "
    "(five seeds). The standard deviation divides by n, which is what the published ones fit. A "
    "dash: not run here. Bold: the better of our methods."
)


def published() -> pd.DataFrame:
    """Return the published means and standard deviations, with our labels and cells.

    >>> figures = published().set_index(["method", "cell"])
    >>> float(figures.loc[("physics", "ethz_1, omega_gain = -1"), "steps_mean"])
    827.0
    """
    figures = pd.read_csv(FIGURES)
    figures["track"] = "ethz_" + figures["track"].astype(str)
    figures["method"] = figures["method"].map(OURS)
    order = ["method", "track", "v_gain", "omega_gain"]
    gains = figures[order].assign(seed=0)
    return figures.assign(cell=short_cell_names(gains))


def published_tables(missions: pd.DataFrame) -> list[Table]:
    """Return the paper's four tables: success and steps, on each of its tracks.

    There are none for a track on which the results hold no mission of a published method under
    a published regime.

    Args:
        missions: with ``cell``.
    """
    figures = published()
    ours = missions.merge(figures[["method", "cell"]], on=["method", "cell"])
    columns = {"success": "success_rate", "steps": "steps"}
    tables = []
    for track in ours["track"].drop_duplicates().sort_values():
        printed = figures[figures["track"] == track]
        for measure, column in columns.items():
            means = ours[ours["track"] == track].groupby(["cell", "method"])[column]
            own = means.agg(ours_mean="mean", ours_std=_deviation, missions="size").reset_index()
            tables.append(_table(str(track), measure, printed.merge(own, "left")))
    return tables


def _deviation(values: pd.Series) -> float:
    return float(values.std(ddof=0))


def _table(track: str, measure: str, figures: pd.DataFrame) -> Table:
    numbers = figures[["track", "v_gain", "omega_gain", "method"]].assign(
        ours_mean=figures["ours_mean"],
        ours_std=figures["ours_std"],
        missions=figures["missions"].fillna(0).astype(int),
        published_mean=figures[f"{measure}_mean"],
        published_std=figures[f"{measure}_std"],
    )
    rows, bold = [], set()
    better = "max" if measure == "success" else "min"
    for place, (gains, group) in enumerate(numbers.groupby(["v_gain", "omega_gain"], sort=False)):
        row = dict(zip(("v_gain", "omega_gain"), map("{:g}".format, gains), strict=True))
        best = group["ours_mean"].agg(better) if group["ours_mean"].nunique() > 1 else None
        for entry in group.itertuples():
            if entry.ours_mean == best:
                bold.add((place, len(row)))
            row[f"{entry.method}, ours"] = _text(entry.ours_mean, entry.ours_std, measure)
            row[f"{entry.method}, published"] = _text(
                entry.published_mean, entry.published_std, measure
            )
        rows.append(row)
    title = f"{measure.capitalize()} on {track}, ours and as published"
    name, note = f"paper_{track}_{measure}", NOTE.format(track=track)
    return Table(name, title, note, numbers, pd.DataFrame(rows), frozenset(bold))


def _text(mean: float, std: float, measure: str) -> str:
    """Return a mean and its deviation as text.

    >>> _text(0.814, 0.05, "success")
    '0.81 ± 0.05'
    """
    digits = DIGITS[measure]
    return "-" if mean != mean else f"{mean:.{digits}f} ± {std:.{digits}f}"
