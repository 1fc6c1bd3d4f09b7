"""Scores of the Actuator Inversion Benchmark, from the folders of its tasks.

    python benchmarks/suites/actuator_inversion/score.py outputs/inversion/*

As published, returns are scaled by the least and the largest of all methods in a task, 0 to 1;
the score of a method is the interquartile mean over contexts and tasks, with its 95 % bootstrap
interval. It depends on the methods that are compared.
"""

import argparse
from pathlib import Path

import pandas as pd

from afm_rl.report import read_runs
from afm_rl.report.statistics import estimate, interquartile_mean
from afm_rl.report.tables import interval_text, markdown

SPLITS = ["train", "in", "out"]


def scores(missions: pd.DataFrame) -> pd.DataFrame:
    """Return score and interval by method and split, and over ``all`` splits."""
    known = missions[missions["regime"].isin(SPLITS)]
    returns = known.groupby("track")["return"]
    low, high = returns.transform("min"), returns.transform("max")
    known = known.assign(score=(known["return"] - low) / (high - low))
    both = pd.concat([known.assign(split="all"), known.assign(split=known["regime"])])
    return pd.DataFrame(
        {"method": method, "split": split, "contexts": len(rows)}
        | estimate("score", rows["score"], rows["scenario"], interquartile_mean)
        for (method, split), rows in both.groupby(["method", "split"], sort=False)
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="results of tasks")
    table = scores(read_runs(parser.parse_args().folders).missions)
    texts = [interval_text(row, "score", 2) for row in table.to_dict("records")]
    wide = table.assign(score=texts).pivot_table(
        index="split", columns="method", values="score", aggfunc="first", sort=False
    )
    print(markdown("score", wide.reset_index()))
