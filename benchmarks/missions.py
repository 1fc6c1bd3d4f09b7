"""A table of missions, from the folders of runs or studies: means, with intervals over seeds.

    python benchmarks/missions.py outputs/study/arm --rows regime --measures return:1 steps:0

Columns are those of `missions.csv`, and `run`, the name of a folder. A measure is a column, its
digits after the point and, if it is to be divided, by what: `return:3:-2500`. With `--columns` all
measures are in one cell; without, each has its own.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from afm_rl.report import read_runs
from afm_rl.report.runs import with_scenarios
from afm_rl.report.statistics import estimate
from afm_rl.report.tables import interval_text, markdown


def table(
    missions: pd.DataFrame, rows: list[str], columns: list[str], measures: list[str]
) -> pd.DataFrame:
    """Return the texts of all groups of missions, in the order in which they were run."""
    shown: dict[str, dict[str, str]] = {}
    for key, group in missions.groupby([*rows, *columns], sort=False):
        names = [str(part) for part in key]
        row = shown.setdefault(", ".join(names[: len(rows)]), {})
        texts = {}
        for name, digits, *unit in (measure.split(":") for measure in measures):
            values = group[name] / float(*unit or [1])
            mean = estimate(name, values, group["scenario"])
            texts[name] = interval_text(mean, name, int(digits))
        row |= {", ".join(names[len(rows) :]): " / ".join(texts.values())} if columns else texts
    wide = pd.DataFrame(shown).T.fillna("–")
    return wide.rename_axis(", ".join(rows)).reset_index()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="results of runs or studies")
    parser.add_argument("--title", default="missions", help="of the table")
    parser.add_argument("--rows", nargs="+", default=["method"], help="columns of missions.csv")
    parser.add_argument("--columns", nargs="*", default=[], help="columns of missions.csv")
    parser.add_argument("--measures", nargs="+", required=True, help="such as steps:0")
    options = parser.parse_args()
    parts = [read_runs([folder]).missions.assign(run=folder.name) for folder in options.folders]
    missions = with_scenarios(pd.concat(parts, ignore_index=True))
    shown = table(missions, options.rows, options.columns, options.measures)
    print(markdown(options.title, shown))


if __name__ == "__main__":
    main()
