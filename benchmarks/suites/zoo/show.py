"""The tables, and one figure that says it all."""

from __future__ import annotations

from pathlib import Path

import pandas as pd


def print_tables(results: pd.DataFrame) -> None:
    """Print the return after the fault, one table per policy."""
    for policy, rows in results.groupby("policy", sort=False):
        means = rows.pivot_table(index="fault", columns="method", values="after", sort=False)
        alive = rows.pivot_table(index="fault", columns="method", values="survived", sort=False)
        print(f"\n{policy}: return after the fault (survivors)\n")
        print(f"| fault | {' | '.join(means)} |\n|---{'|---' * len(means.columns)}|")
        for fault in means.index:
            cells = [f"{means.at[fault, m]:.0f} ({alive.at[fault, m]:.0%})" for m in means]
            print(f"| {fault} | {' | '.join(cells)} |")


def draw(results: pd.DataFrame, file: Path) -> None:
    """Draw the figure."""
