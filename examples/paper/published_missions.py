"""Missions with variations of one method, beside its published row; each mission as a CSV row.

    python examples/paper/published_missions.py stream_x outputs/stream_x/jobs/*
    python examples/paper/published_missions.py stream_x  # the table again, from the CSV file

Given folders of runs, it first replaces the missions of the study in ``missions.csv`` beside this
program. A row of the table is a run. It compares the scenarios that all runs have.
"""

import argparse
from pathlib import Path

import pandas as pd
from published_tables import LABELS, MEASURES, flights_table, published

from afm_rl.report import read_runs
from afm_rl.report.statistics import estimate
from afm_rl.report.tables import interval_text, markdown
from afm_rl.storage.files import csv_text, write_whole

FILE = Path(__file__).with_name("missions.csv")
DIGITS, CELL = {"success": 3, "steps": 0}, {"success": 2, "steps": 0}
COLUMNS = ["study", "run", "method", "track", "regime", "seed", "success_rate", "steps", "mse"]


def collected(folders: list[Path]) -> pd.DataFrame:
    """Return the missions of runs."""
    missions = pd.concat(
        [read_runs([folder]).missions.assign(run=folder.name) for folder in folders]
    )
    methods = missions["method"].str.partition("+")[0]  # jobs append their settings
    return missions.assign(method=methods)


def store(study: str, missions: pd.DataFrame) -> None:
    """Write the missions of a study into the file, where they replace those before."""
    missions = missions.assign(study=study).reindex(columns=COLUMNS)
    others = pd.read_csv(FILE).query("study != @study") if FILE.is_file() else None
    together = pd.concat([others, missions]).sort_values("study", kind="stable")
    write_whole(FILE, csv_text(together.round(6)).encode())


def missions_of(study: str) -> pd.DataFrame:
    """Return the missions of a study, with the names of their scenarios."""
    missions = pd.read_csv(FILE).query("study == @study")
    return missions.assign(scenario=missions["track"] + ", " + missions["regime"])


def table_of(missions: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a study: of the quadrotor, or of variations of one method."""
    flies = missions["mse"].notna().any()
    return flights_table(missions).shown if flies else variations(missions)


def variations(missions: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each run, below the published one, with a column for each regime.

    *Off* is the root mean square difference between the means of scenarios and the published ones.
    """
    runs = dict(tuple(missions.groupby("run", sort=False)))
    shared = set.intersection(*(set(run["scenario"]) for run in runs.values()))
    printed = published()[lambda table: table["method"] == LABELS[missions["method"].iloc[0]]]
    printed = printed[printed["scenario"].isin(shared)].set_index("scenario")
    regimes = [name.partition(", ")[2] for name in printed.index]
    names = [f"{name}_{kind}" for name in MEASURES for kind in ("mean", "std")]
    rows = [_row("published", printed[names], regimes)]
    for name, run in runs.items():
        own = run[run["scenario"].isin(shared)]
        figures = own.groupby("scenario")[list(MEASURES.values())]
        figures = figures.agg(["mean", lambda values: values.std(ddof=0)]).loc[printed.index]
        figures.columns = names
        row = _row(name, figures, regimes)
        for head, column in MEASURES.items():
            digits = DIGITS[head]
            off = (figures - printed)[f"{head}_mean"].pow(2).mean() ** 0.5
            row[f"{head}, off by"] = f"{off:.{digits}f}"
            row[head] = interval_text(estimate(head, own[column], own["scenario"]), head, digits)
        rows.append(row)
    return pd.DataFrame(rows)


def _row(name: str, figures: pd.DataFrame, regimes: list[str]) -> dict[str, str]:
    """Return the means over scenarios, and a cell for each regime."""
    row = {"run": name}
    for head, digits in DIGITS.items():
        row[head] = f"{figures[f'{head}_mean'].mean():.{digits}f}"
        row[f"{head}, off by"] = "-"
    cells = figures.apply(_cell, axis=1).groupby(regimes, sort=False).agg("; ".join)
    return row | cells.to_dict()


def _cell(figure: pd.Series) -> str:
    """Return the success, or the steps if every mission reaches every target."""
    head = "steps" if figure["success_mean"] == 1 else "success"
    return " ± ".join(f"{figure[f'{head}_{kind}']:.{CELL[head]}f}" for kind in ("mean", "std"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("study", help="name of the study in the CSV file")
    parser.add_argument("folders", nargs="*", type=Path, help="results of its runs")
    options = parser.parse_args()
    if options.folders:
        store(options.study, collected(options.folders))
    print(markdown(options.study, table_of(missions_of(options.study))))
