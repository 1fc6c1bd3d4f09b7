"""The tables of the suite, and a figure of all policies, faults and methods."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from afm_rl.comparison.result import share_of
from afm_rl.report import style
from afm_rl.report.tables import markdown
from afm_rl.storage.files import write_whole

HARM = 0.05  # share of the healthy return
SHORT = ["none", "all reversed", "half", "dead", "late 4", "reversed and late 2"]


def shares(results: pd.DataFrame) -> pd.DataFrame:
    """Return results with the ``share`` of the healthy return of each policy."""
    parts = [
        rows.assign(share=share_of(rows, "without AFM")) for _, rows in results.groupby("policy")
    ]
    return pd.concat(parts)


def ordered(results: pd.DataFrame, methods: Sequence[str], faults: Sequence[str]) -> pd.DataFrame:
    """Return results whose methods and faults sort in the given order."""
    columns = {
        name: pd.Categorical(results[name], [x for x in order if x in set(results[name])])
        for name, order in (("method", methods), ("fault", faults))
    }
    return results.assign(**columns)


def print_each(results: pd.DataFrame) -> None:
    """Print the return after the fault of each policy."""
    cases = results.sort_values(["policy", "fault"])
    names = cases["policy"] + ", " + cases["fault"].astype(str)
    cases = cases.assign(fault=pd.Categorical(names, names.unique()))
    print(markdown("each", table_by(cases, "method", _sum)))


def print_tables(results: pd.DataFrame) -> None:
    """Print the return after the fault of each policy, and the means over all policies."""
    methods = list(results["method"].cat.categories)
    if methods[0] == "without AFM" and len(methods) in (2, 3):
        returns = table_by(results, "policy", lambda rows: _change(rows, methods))
        print(markdown("returns", returns))
        short = returns[returns["fault"].isin(SHORT)]
        print(markdown("short", short.replace(r"( \(|, \d+ fell).*", "", regex=True)))
    parts = [
        table_by(results, "method", cell).set_index("fault").add_prefix(f"{name}: ")
        for name, cell in ALL.items()
    ]
    print(markdown("shares", pd.concat(parts, axis=1).reset_index()))
    print(markdown(f"less than without AFM by more than {HARM}", harmed(results)))


def harmed(results: pd.DataFrame) -> pd.DataFrame:
    """Return where a correction has less of the healthy return than the policy without AFM."""
    keys = ["policy", "fault"]
    table = results.pivot_table(index=keys, columns="method", values="share", observed=True)
    rows = []
    for method in table.columns.drop("without AFM"):
        lost = (
            (table["without AFM"] - table[method]).loc[lambda gap: gap > HARM].sort_values()[::-1]
        )
        where = ", ".join(f"{policy} {fault} -{gap:.2f}" for (policy, fault), gap in lost.items())
        rows.append([method, len(lost), table[method].count(), where])
    return pd.DataFrame(rows, columns=["method", "less", "of", "where"])


def table_by(results: pd.DataFrame, column: str, cell: Callable[..., str]) -> pd.DataFrame:
    """Return ``cell`` of the rows of each fault, with a column for each value of ``column``."""
    groups = results.groupby(["fault", column], observed=True)[list(results)]
    wide = groups.apply(cell).unstack(fill_value="–")
    return wide.set_axis(list(wide), axis=1).reset_index().astype(str)


def _change(rows: pd.DataFrame, methods: list[str]) -> str:
    """Return the mean returns, without AFM → corrected (oracle), and the number of falls."""
    groups = [rows[rows["method"] == method] for method in methods]
    without, corrected, *oracle = (f"{group['after'].mean():.0f}" for group in groups)
    fell = (~groups[1]["survived"].astype(bool)).sum()
    text = f"{without} → {corrected}" + "".join(f" ({value})" for value in oracle)
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
    policies, rows = sorted(set(results["policy"])), -(-len(methods) // 2)
    size = 5.0 + 0.5 * len(policies), rows * (2.0 + 0.3 * len(faults))
    figure = style.new_figure(*size, dpi=100)
    panels = figure.subplots(rows, 2, sharey=True, squeeze=False).flatten()
    for panel, method in zip(panels, methods, strict=False):
        mine = results[results["method"] == method]
        table = mine.pivot_table(index="fault", columns="policy", values="share", observed=False)
        table = table.reindex(index=faults, columns=policies)
        picture = panel.imshow(table, vmin=0, vmax=1, cmap="cividis", aspect="auto")
        panel.set_title(method)
        panel.set_xticks(range(len(policies)), policies, rotation=90)
        panel.set_yticks(range(len(faults)), faults)
    for spare in panels[len(methods) :]:
        spare.set_axis_off()
    figure.colorbar(picture, ax=list(panels), shrink=0.6, label="share of the healthy return")
    write_whole(file, style.png_bytes(figure))
