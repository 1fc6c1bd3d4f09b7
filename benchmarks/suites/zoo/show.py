"""The tables, and one figure that says it all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

HARM = 0.05  # share of the healthy return
NUMBERED = 8  # policies up to which each cell has its number


def shares(results: pd.DataFrame) -> pd.DataFrame:
    """Return results with the ``share`` of the healthy return after the fault.

    1 is what the policy alone has without a fault. 0 is a return of 0, or, where rewards are costs,
    that of all actuators reversed.
    """
    alone = results[results["method"] == "alone"]
    means = alone.pivot_table(index="policy", columns="fault", values="after", observed=True)
    healthy, lost = means["none"], 0.0
    if "all reversed" in means:
        lost = means["all reversed"].where(healthy < 0, 0.0)
    low, high = results["policy"].map(lost if np.ndim(lost) else healthy * lost), healthy
    share = (results["after"] - low) / (results["policy"].map(high) - low)
    return results.assign(share=share)


def ordered(results: pd.DataFrame, methods: list[str], faults: list[str]) -> pd.DataFrame:
    """Return results whose methods and faults sort in the given order."""
    kinds = {"method": methods, "fault": faults}
    columns = {
        name: pd.Categorical(results[name], [x for x in order if x in set(results[name])])
        for name, order in kinds.items()
    }
    return results.assign(**columns)


def print_tables(results: pd.DataFrame) -> None:
    """Print the return after the fault of each policy, and what all have in common."""
    for policy, rows in results.groupby("policy"):
        print(f"\n{policy}: return after the fault (survivors, where some fell)\n")
        print_table(rows, _sum)
    for title, cell in ALL.items():
        print(f"\nAll policies: {title}\n")
        print_table(results, cell)
    harmed(results)


def harmed(results: pd.DataFrame) -> None:
    """Say where a correction has less of the healthy return than the policy alone."""
    keys = ["policy", "fault"]
    table = results.pivot_table(index=keys, columns="method", values="share", observed=True)
    for method in table.columns.drop("alone"):
        lost = (table["alone"] - table[method]).loc[lambda gap: gap > HARM].sort_values()[::-1]
        cases = ", ".join(f"{policy} {fault} -{gap:.2f}" for (policy, fault), gap in lost.items())
        print(f"\nless than alone by more than {HARM}, {method}: {cases or 'nowhere'}")


def print_table(rows: pd.DataFrame, cell) -> None:
    methods = rows["method"].cat.categories
    print(f"| fault | {' | '.join(methods)} |\n|---{'|---' * len(methods)}|")
    for fault, mine in rows.groupby("fault", observed=True):
        groups = [mine[mine["method"] == method] for method in methods]
        print(f"| {fault} | {' | '.join(cell(x) if len(x) else '–' for x in groups)} |")


def _sum(rows: pd.DataFrame) -> str:
    alive = rows["survived"].mean()
    return f"{rows['after'].mean():.0f}" + ("" if alive == 1 else f" ({alive:.0%})")


def _steps(rows: pd.DataFrame) -> str:
    return f"{np.quantile(rows['recovered'], 0.5, method='lower'):.0f}".replace("inf", "∞")


ALL = {
    "share of the healthy return": lambda rows: f"{rows['share'].mean():.2f}",
    "survivors": lambda rows: f"{rows['survived'].mean():.0%}",
    "median steps until recovered": _steps,
}


def draw(results: pd.DataFrame, file: Path) -> None:
    """Draw the shares: a panel per method, a row per fault, a column per policy."""
    methods, faults = (list(results[name].cat.categories) for name in ("method", "fault"))
    policies = sorted(set(results["policy"]))
    few = len(policies) <= NUMBERED
    across = len(methods) if few else 2
    down = -(-len(methods) // across)
    wide, high = max(0.34 * len(policies), 1.6), 1.6 + 0.34 * len(faults)
    figure = Figure(figsize=(1.9 + wide * across, high * down), dpi=160 if few else 100)
    grid = figure.subplots(down, across, sharey=True, squeeze=False, gridspec_kw={"hspace": 0.5})
    panels = grid.flatten()
    for spare in panels[len(methods) :]:
        spare.set_axis_off()
    for panel, method in zip(panels, methods, strict=False):
        mine = results[results["method"] == method]
        table = mine.pivot_table(index="fault", columns="policy", values="share", observed=False)
        table = table.reindex(index=faults, columns=policies)
        picture = panel.imshow(table, vmin=0, vmax=1, cmap="cividis", aspect="auto")
        panel.set_title(method, fontsize=10)
        names = [name.replace("_", " ") for name in policies]
        panel.set_xticks(range(len(policies)), names, rotation=90, fontsize=7)
        panel.set_yticks(range(len(faults)), faults, fontsize=8)
        panel.tick_params(length=0)
        if few:
            for row, column in np.argwhere(table.notna().to_numpy()):
                value = table.iloc[row, column]
                colour = "white" if value < 0.55 else "black"
                text = f"{100 * value:.0f}"
                panel.text(column, row, text, ha="center", va="center", color=colour, fontsize=6.5)
    bar = figure.colorbar(picture, ax=list(panels), shrink=0.6, pad=0.01)
    bar.set_label("share of the healthy return", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    FigureCanvasAgg(figure)
    figure.savefig(file, bbox_inches="tight", facecolor="white")
