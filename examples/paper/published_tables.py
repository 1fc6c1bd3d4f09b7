"""Our means beside those that the paper printed: four tables, as CSV and LaTeX.

    python examples/paper/published_tables.py outputs/study/ugv_paper

The paper gave each mission 5000 steps, and one that ran out counts 4999, the number of its last
step. Steps of ours compare with these only under the same budget: the tables say where it differs.
"""

import argparse
from pathlib import Path

import pandas as pd

from afm_rl.report import read_runs
from afm_rl.report.runs import cell_names
from afm_rl.report.tables import Table
from afm_rl.storage.files import write_whole

LAST = 4999  # step of a published mission that ran out
LABELS = {  # the paper's name: our label
    "afm": "afm_paper",
    "online_pe": "online_pe",
    "stream_x_pe": "stream_x_pe",
    "physics": "physics",
    "frozen_pe": "frozen_pe",
}
MEASURES = {"success": ("success_rate", "max", 2), "steps": ("steps", "min", 0)}
NOTE = (
    "Mean ± standard deviation over the seeds of one regime on {track}: ours, then as published "
    "(five seeds; a mission that ran out counts 4999 of 5000 steps). The standard deviation "
    "divides by n, which is what the published ones fit. A dash: not run here. Bold: the better of "
    "our methods.{budget}"
)


def published() -> pd.DataFrame:
    """Return the published means and standard deviations, with our labels and cells."""
    figures = pd.read_csv(Path(__file__).with_name("published.csv"))
    figures["track"] = "ethz_" + figures["track"].astype(str)
    figures["method"] = figures["method"].map(LABELS)
    named = figures[["method", "track", "v_gain", "omega_gain"]].assign(seed=0)
    return figures.assign(cell=cell_names(named))


def tables(missions: pd.DataFrame) -> list[Table]:
    """Return success and steps on each track on which there are missions of a published method."""
    figures = published()
    ours = missions.merge(figures[["method", "cell"]], on=["method", "cell"])
    given_up = ours.loc[~ours["finished"].astype(bool), "steps"]
    other = sorted(set(given_up) - {LAST})
    budget = (
        f" Ours count {' or '.join(map(str, other))}: our budget was another one, so steps and "
        "success do not compare."
        if other
        else ""
    )
    found = []
    for track in sorted(ours["track"].unique()):
        printed = figures[figures["track"] == track]
        for measure, (column, _, _) in MEASURES.items():
            means = ours[ours["track"] == track].groupby(["cell", "method"])[column]
            own = means.agg(["mean", lambda values: values.std(ddof=0), "size"]).reset_index()
            own.columns = ["cell", "method", "ours_mean", "ours_std", "missions"]
            found.append(table(track, measure, printed.merge(own, "left"), budget))
    return found


def table(track: str, measure: str, figures: pd.DataFrame, budget: str) -> Table:
    """Return one of the paper's tables: a row per regime, two columns per method."""
    _, better, digits = MEASURES[measure]
    rows, bold = [], set()
    for place, (gains, group) in enumerate(figures.groupby(["v_gain", "omega_gain"], sort=False)):
        row = dict(zip(("v_gain", "omega_gain"), map("{:g}".format, gains), strict=True))
        best = group["ours_mean"].agg(better) if group["ours_mean"].nunique() > 1 else None
        for entry in group.to_dict("records"):
            if entry["ours_mean"] == best:
                bold.add((place, len(row)))
            for whose, name in (("ours", "ours"), (measure, "published")):
                mean, std = entry[f"{whose}_mean"], entry[f"{whose}_std"]
                text = "-" if mean != mean else f"{mean:.{digits}f} ± {std:.{digits}f}"
                row[f"{entry['method']}, {name}"] = text
        rows.append(row)
    title = f"{measure.capitalize()} on {track}, ours and as published"
    note = NOTE.format(track=track, budget=budget)
    name = f"paper_{track}_{measure}"
    return Table(name, title, note, figures, pd.DataFrame(rows), frozenset(bold))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="results of runs or studies")
    parser.add_argument("--out", type=Path, help="where to (FOLDER/report/tables, of the first)")
    options = parser.parse_args()
    out = options.out or options.folders[0] / "report" / "tables"
    for each in tables(read_runs(options.folders).missions):
        write_whole(out / f"{each.name}.csv", each.to_csv().encode())
        write_whole(out / f"{each.name}.tex", each.to_latex().encode())
        print(f"{each.title}. {each.note}\n{each.shown.to_string(index=False)}\n")
