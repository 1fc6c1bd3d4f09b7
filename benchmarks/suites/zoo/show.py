"""The tables, and one figure that says it all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from afm_rl.report.tables import markdown

HARM = 0.05  # share of the healthy return
SHORT = ["none", "all reversed", "half", "dead", "late 4", "reversed and late 2"]
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
    methods = list(results["method"].cat.categories)
    if methods[0] == "alone" and len(methods) in (2, 3):
        returns = table_by(results, "policy", lambda rows: _change(rows, methods))
        print(markdown("returns", returns))
        short = returns[returns["fault"].isin(SHORT)]
        print(markdown("short", short.replace(r"( \(|, \d+ fell).*", "", regex=True)))
    cases = results.sort_values(["policy", "fault"])
    names = cases["policy"] + ", " + cases["fault"].astype(str)
    cases = cases.assign(fault=pd.Categorical(names, names.unique()))
    print(markdown("each", table_by(cases, "method", _sum)))
    parts = [
        table_by(results, "method", cell).set_index("fault").add_prefix(f"{name}: ")
        for name, cell in ALL.items()
    ]
    print(markdown("shares", pd.concat(parts, axis=1).reset_index()))
    print(markdown(f"less than alone by more than {HARM}", harmed(results)))


def harmed(results: pd.DataFrame) -> pd.DataFrame:
    """Say where a correction has less of the healthy return than the policy alone."""
    keys = ["policy", "fault"]
    table = results.pivot_table(index=keys, columns="method", values="share", observed=True)
    rows = []
    for method in table.columns.drop("alone"):
        lost = (table["alone"] - table[method]).loc[lambda gap: gap > HARM].sort_values()[::-1]
        where = ", ".join(f"{policy} {fault} -{gap:.2f}" for (policy, fault), gap in lost.items())
        rows.append([method, len(lost), table[method].count(), where])
    return pd.DataFrame(rows, columns=["method", "less", "of", "where"])


def table_by(results: pd.DataFrame, column: str, cell: Callable[..., str]) -> pd.DataFrame:
    """Return what ``cell`` says of the rows of each fault, with a column for each kind."""
    groups = results.groupby(["fault", column], observed=True)[list(results)]
    wide = groups.apply(cell).unstack(fill_value="–")
    return wide.set_axis(list(wide), axis=1).reset_index().astype(str)


def _change(rows: pd.DataFrame, methods: list[str]) -> str:
    """Say what becomes of the return: alone → corrected (truth), and how many fell."""
    groups = [rows[rows["method"] == method] for method in methods]
    alone, corrected, *truth = (f"{group['after'].mean():.0f}" for group in groups)
    fell = (~groups[1]["survived"].astype(bool)).sum()
    text = f"{alone} → {corrected}" + "".join(f" ({value})" for value in truth)
    return text + (f", {fell} fell" if fell else "")


def _sum(rows: pd.DataFrame) -> str:
    alive = rows["survived"].mean()
    return f"{rows['after'].mean():.0f}" + ("" if alive == 1 else f" ({alive:.0%})")


def _steps(rows: pd.DataFrame) -> str:
    return f"{np.quantile(rows['recovered'], 0.5, method='lower'):.0f}".replace("inf", "∞")


ALL = {
    "share": lambda rows: f"{rows['share'].mean():.2f}",
    "survive": lambda rows: f"{rows['survived'].mean():.0%}",
    "steps": _steps,
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
