"""The tables of a report: what they hold; as CSV and Markdown, and in a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO

import pandas as pd
from rich import box
from rich.console import Console, JustifyMethod
from rich.table import Table as Grid
from rich.text import Text

from afm_rl.report.runs import outcome
from afm_rl.report.statistics import summarise
from afm_rl.storage.files import csv_text
from afm_rl.storage.measures import Measures, number

BOOTSTRAP = (
    "Brackets are 95 % intervals of the stratified bootstrap (Agarwal et al. 2021): seeds are "
    "resampled within each scenario. There is no bracket if no scenario has two missions, or if "
    "all missions are equal. "
)


@dataclass(frozen=True)
class Table:
    """One table: its numbers, and how they are shown.

    Attributes:
        name: file name, without an ending.
        title: what it is about.
        note: how to read it.
        numbers: for programs; becomes the CSV file.
        shown: the same for people: text, one column per head; becomes HTML.
        bold: places ``(row, column)`` of ``shown`` that stand out.
    """

    name: str
    title: str
    note: str
    numbers: pd.DataFrame
    shown: pd.DataFrame
    bold: frozenset[tuple[int, int]] = field(default_factory=frozenset)

    def to_csv(self) -> str:
        """Return the numbers as CSV."""
        return csv_text(self.numbers)

    def to_grid(self, columns: Sequence[int] | None = None, caption: str | None = None) -> Grid:
        """Return some columns of the table, or all, for the terminal."""
        chosen = list(range(self.shown.shape[1]) if columns is None else columns)

        def look(row: int, column: int) -> str:
            return "bold" if (row, chosen[column]) in self.bold else ""

        return grid_of(self.shown.iloc[:, chosen], look, "right", caption)


def grid_of(
    shown: pd.DataFrame,
    look: Callable[[int, int], str] = lambda row, column: "",
    justify: JustifyMethod = "left",
    caption: str | None = None,
) -> Grid:
    """Return texts as a table for the terminal, by the look of each place ``(row, column)``."""
    grid = Grid(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False, caption=caption)
    for column, head in enumerate(shown):
        grid.add_column(Text(str(head)), justify=justify if column else "left")
    for row, texts in enumerate(shown.to_numpy()):
        grid.add_row(*(Text(text, look(row, column)) for column, text in enumerate(texts)))
    return grid


def markdown(title: str, shown: pd.DataFrame) -> str:
    """Return texts as a table of Markdown, under its title.

    >>> print(markdown("returns", pd.DataFrame({"fault": ["none"], "AFM": [1]})))
    <BLANKLINE>
    returns:
    <BLANKLINE>
    | fault | AFM |
    |---|---|
    | none | 1 |
    """
    rows = [f"| {' | '.join(map(str, row))} |" for row in [list(shown), *shown.to_numpy().tolist()]]
    rows.insert(1, "|" + "---|" * shown.shape[1])
    return "\n".join(["", f"{title}:", "", *rows])


def terminal(file: IO[str] | None) -> Console:
    """Return what prints tables to a file, or to standard output: plain text off a terminal."""
    # Numbers that are cut off are worse than lines that wrap.
    return Console(file=file, width=1000, highlight=False)


def interval_text(
    row: Mapping[str, float], name: str, digits: int, scale: float = 1.0, sign: str = ""
) -> str:
    """Return an entry of a row as text, with its interval.

    Args:
        row: has the entries ``name``, ``name_low`` and ``name_high``.
        name: of the entry.
        digits: after the point.
        scale: what the numbers are multiplied by.
        sign: ``"+"`` writes the sign of positive numbers, too.

    >>> row = {"a": 0.5, "a_low": -0.4, "a_high": 0.6}
    >>> interval_text(row, "a", 1, 100), interval_text(row, "a", 1, sign="+")
    ('50.0 [-40.0, 60.0]', '+0.5 [-0.4, +0.6]')
    """
    values = (row[key] for key in (name, f"{name}_low", f"{name}_high"))
    middle, low, high = (
        (sign if value >= 0 else "") + number(scale * value, digits) for value in values
    )
    return middle if low == "-" else f"{middle} [{low}, {high}]"


def print_summary(
    missions: pd.DataFrame, measures: Measures, file: IO[str] | None = None, abreast: int = 6
) -> None:
    """Print the table of methods, then one of scenarios x methods if there are several scenarios.

    In a terminal the best values are bold; a pipe or a file gets plain text. The tables are those
    of the report, intervals included.

    Args:
        missions: one row per mission.
        measures: measures for the comparison.
        file: output; standard output by default.
        abreast: methods per table of scenarios; further methods are in a table below.

    >>> from afm_rl.storage.measures import Measure
    >>> steps = Measures((Measure("steps", "steps", "steps", better="lower"),))
    >>> row = {"method": "physics", "track": "oval", "seed": 0, "steps": 300, "finished": True}
    >>> print_summary(pd.DataFrame([row]), steps)  # doctest: +NORMALIZE_WHITESPACE
    <BLANKLINE>
     method   missions  finished (%)  steps
     ──────────────────────────────────────
     physics         1           100    300
    <BLANKLINE>
    """
    console = terminal(file)
    table = summary_table(summarise(missions, measures), measures)
    has_intervals = any("[" in text for text in table.shown.iloc[:, 1:].to_numpy().ravel())
    caption = "mean [95 % interval, seeds resampled within scenarios]" if has_intervals else None
    console.print(table.to_grid(caption=caption))
    scenarios = scenario_table(missions, measures)
    if len(scenarios.shown) > 1:
        caption = f"{' / '.join(measure.head for measure in measures.headlines)}, means"
        columns = range(1, scenarios.shown.shape[1])
        for first in range(0, len(columns), abreast):
            console.print(scenarios.to_grid([0, *columns[first : first + abreast]], caption))


def summary_table(means: pd.DataFrame, measures: Measures, oracle: str = "") -> Table:
    """Return :func:`~.statistics.aggregate`, or as much of it as there is, as a table.

    The best of all complete methods is bold, but for the oracle: it knows what no other method
    knows and does not compete, and neither does a method that was spared some scenarios.
    """
    rows, ended = [], outcome(means)
    signs = {f"{ended} (%)": (ended, 1 if ended == "finished" else -1)}
    for row in means.to_dict("records"):
        shown = {"method": row["method"], "missions": str(row["missions"])}
        shown[f"{ended} (%)"] = number(100 * row[ended])
        for measure in measures:
            for name, word in ((measure.column, ""), (f"{measure.column}_iqm", ", IQM")):
                if name in means:
                    signs[measure.head + word] = name, measure.sign
                    text = interval_text(row, name, measure.digits, measure.scale)
                    shown[measure.head + word] = text
        if "faults" in means and means["faults"].any():
            shown["faults"] = number(row["faults"])
        if "seconds" in means:
            shown["seconds"] = number(row["seconds"], 1)
        rows.append(shown)
    table, bold = pd.DataFrame(rows), set()
    complete = (means["missions"] == means["missions"].max()) & (means["method"] != oracle)
    for head, (name, sign) in signs.items():
        rivals = (sign * means[name].astype(float)).where(complete).reset_index(drop=True)
        if rivals.nunique() > 1:
            column = table.columns.get_loc(head)
            bold |= {(row, column) for row in rivals.index[rivals == rivals.max()]}
    note = "IQM is the mean of the middle half of the missions. " + BOOTSTRAP
    if measures.budget:
        note += "A mission that did not finish counts with its budget. "
    note += f"Bold: the best of those with the most missions, {oracle} apart."
    return Table("aggregate", "All missions of each method", note, means, table, frozenset(bold))


def comparison_tables(numbers: pd.DataFrame, measures: Measures) -> list[Table]:
    """Return :func:`~.statistics.compare` as one table per baseline."""
    tables = []
    note = (
        "Differences are means over missions of the same scenario and seed (n pairs). "
        + BOOTSTRAP
        + "Bold where 0 lies outside the interval."
    )
    groups = numbers.groupby("baseline", sort=False) if len(numbers) else ()
    for baseline, group in groups:
        shown, bold = [], set()
        for place, row in enumerate(group.to_dict("records")):
            texts = {"method": row["method"], "n pairs": str(row["pairs"])}
            for column, measure in enumerate(measures, 2):
                name = measure.column
                texts[measure.head] = interval_text(row, name, measure.digits, measure.scale, "+")
                if row[f"{name}_low"] > 0 or row[f"{name}_high"] < 0:
                    bold.add((place, column))
            shown.append(texts)
        name, title = f"against_{baseline}", f"Differences from {baseline}"
        numbers = group.reset_index(drop=True)
        tables.append(Table(name, title, note, numbers, pd.DataFrame(shown), frozenset(bold)))
    return tables


def scenario_table(missions: pd.DataFrame, measures: Measures) -> Table:
    """Return the means of each method (a column) in each scenario (a row), by the headlines."""
    timeless = missions.drop(columns="seconds", errors="ignore")  # the same file for the same runs
    numbers = summarise(timeless, measures, ["scenario", "method"])
    heads, rows, bold = ["scenario", *missions["method"].unique()], [], set()
    short = measures.headlines
    for place, (scenario, group) in enumerate(numbers.groupby("scenario", sort=False)):
        texts, rank = dict.fromkeys(heads, "-") | {"scenario": scenario}, {}
        for row in group.to_dict("records"):
            # Many numbers side by side: whole percentages are enough.
            values = [m.text(row[m.column], 0 if m.scale > 1 else m.digits) for m in short]
            texts[row["method"]] = " / ".join(values)
            rank[row["method"]] = tuple(m.sign * row[m.column] for m in short)
        rows.append(texts)
        if len(set(rank.values())) > 1:
            best = max(rank.values())
            bold |= {(place, heads.index(name)) for name in rank if rank[name] == best}
    heads_of = " / ".join(measure.head for measure in short)
    note = f"Means: {heads_of}. Bold: the best of a scenario."
    return Table(
        "scenarios", "Scenario by scenario", note, numbers, pd.DataFrame(rows), frozenset(bold)
    )


def missing_table(missing: pd.DataFrame, scenarios: int) -> Table:
    """Return the table of what is missing, one row per method and set of seeds."""
    rows = []
    seeds = missing.groupby(["method", "scenario"], sort=False)["seed"].agg(tuple).reset_index()
    for (method, numbers), group in seeds.groupby(["method", "seed"], sort=False):
        names = f"all {scenarios}" if len(group) == scenarios else "; ".join(group["scenario"])
        row = {"method": method, "missions": str(len(group) * len(numbers))}
        rows.append(row | {"seeds": ", ".join(map(str, numbers)), "scenarios": names})
    note = "Every method is expected to have every scenario and seed that any method has."
    return Table("missing", "Missing missions", note, missing, pd.DataFrame(rows))
