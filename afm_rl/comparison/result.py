"""What a comparison found: a table, a figure, a page."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from afm_rl.comparison.episodes import Played, rows_of, usual
from afm_rl.errors import check_choice
from afm_rl.report import style
from afm_rl.report.figures import Picture
from afm_rl.report.statistics import estimate
from afm_rl.report.tables import Table, interval_text
from afm_rl.report.write import render_page
from afm_rl.storage.files import csv_text, write_whole

NOTE = (
    "Returns are from the fault to the end of an episode: mean and 95 % interval. Share: of the "
    "healthy return. Survived: episodes that the robot did not end. Recovery: median steps until "
    "the reward is as before. Difference: from the episode of the same seed without AFM; WORSE if "
    "it is negative beyond its interval."
)


@dataclass(frozen=True)
class Comparison:
    """Episodes of a policy under faults, for each method; made by :func:`~afm_rl.compare`.

    It prints itself as a table of Markdown, and shows itself in a notebook.

    Attributes:
        title: robot and policy.
        faults: names, the healthy robot first.
        seeds: of the episodes of each fault.
        at: steps before the fault.
        played: rewards ``(T, N)`` and ends ``(N,)`` of each method, no correction first; the N
            episodes are those of each fault in turn.
        verdict: what is wrong with the model; empty if it is right.
        window: steps over which rewards are averaged to see whether they are as before.
    """

    title: str
    faults: Sequence[str]
    seeds: Sequence[int]
    at: int
    played: Mapping[str, Played]
    verdict: str
    window: int

    @property
    def methods(self) -> list[str]:
        """Names of the methods, no correction first."""
        return [*self.played]

    @property
    def steps(self) -> int:
        """Of an episode, at most."""
        return len(self.played["none"].rewards)

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """One row per fault, method and episode.

        Columns: ``before`` and ``after``, the returns until the fault and from it on; ``share`` of
        the healthy return; ``survived``: the robot did not end the episode; ``lasted``, its steps;
        ``recovered``, the steps from the fault until the rewards stay as they were (infinity: not
        within the episode).
        """
        healthy = self.played["none"].rewards[self.at :, : len(self.seeds)]
        cases = [(fault, seed) for fault in self.faults for seed in self.seeds]
        rows = [
            {"method": method, **row}
            for method, played in self.played.items()
            for row in rows_of(played, cases, self.at, usual(healthy, self.window), self.window)
        ]
        found = pd.DataFrame(rows)
        return found.assign(share=share_of(found))

    @cached_property
    def table(self) -> pd.DataFrame:
        """One row per fault and method.

        Means of ``return`` (from the fault on) and ``share``, and of the ``difference`` of each
        episode from the one without a correction, each with ``_low`` and ``_high``, a 95 %
        bootstrap interval (NaN if all episodes are alike, or there is one); ``survived``, a share;
        ``recovered``, the median; ``worse``: is the difference negative beyond its interval?
        """
        rows, groups = [], self.episodes.groupby(["fault", "method"], sort=False)
        for fault in self.faults:
            alone = groups.get_group((fault, "none")).reset_index(drop=True)
            one = alone["fault"]  # a stratum
            for method in self.methods:
                mine = groups.get_group((fault, method)).reset_index(drop=True)
                row: dict[str, Any] = {"fault": fault, "method": method}
                row |= estimate("return", mine["after"], one)
                row |= estimate("share", mine["share"], one)
                row |= {"survived": mine["survived"].mean()}
                row |= {"recovered": mine["recovered"].quantile(interpolation="lower")}
                row |= estimate("difference", mine["after"] - alone["after"], one)
                high = row["difference_high"]
                sure = high < 0 if not math.isnan(high) else len(mine) > 1
                row["worse"] = bool(sure and row["difference"] < 0)
                rows.append(row)
        return pd.DataFrame(rows)

    @cached_property
    def shown(self) -> pd.DataFrame:
        """The table for people: one row per fault, texts."""
        rows = []
        for fault in self.faults:
            mine = self.table[self.table["fault"] == fault].set_index("method")
            each, row = mine.to_dict("index"), {"fault": fault}
            digits = 0 if self.table["return"].abs().max() >= 100 else 2
            for method in self.methods:
                row[_named(method)] = interval_text(each[method], "return", digits)
            row["share"] = " → ".join(f"{value:.2f}" for value in mine["share"])
            row["survived"] = " → ".join(f"{value:.0%}" for value in mine["survived"])
            row["recovery"] = " → ".join(f"{x:.0f}".replace("inf", "∞") for x in mine["recovered"])
            for method in self.methods[1:]:
                text = interval_text(each[method], "difference", digits, sign="+")
                text += " WORSE" * each[method]["worse"]
                row[f"difference {_named(method)}"] = text
            rows.append(row)
        return pd.DataFrame(rows)

    @property
    def heading(self) -> str:
        """What was compared, in a line."""
        count, last = len(self.seeds), self.steps
        when = f"fault at step {self.at} of {last}"
        return f"{self.title}: {when}, {count} episode{'s' * (count > 1)} of each"

    @property
    def footnote(self) -> str:
        """How to read the figure."""
        return f"{self.heading}; dotted: the healthy robot without a correction"

    def __str__(self) -> str:
        texts = [[*self.shown], *self.shown.to_numpy().tolist()]
        widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
        lines = [f"| {' | '.join(map(str.ljust, row, widths))} |" for row in texts]
        lines.insert(1, f"|{'|'.join('-' * (width + 2) for width in widths)}|")
        wrong = [f"THE MODEL IS WRONG: {self.verdict}"] if self.verdict else []
        return "\n".join([*wrong, f"{self.heading}:", "", *lines, "", NOTE])

    def _repr_html_(self) -> str:
        """Return the table for a notebook."""
        wrong = f"<b>The model is wrong.</b> {html.escape(self.verdict)}"
        parts = [f'<p class="wrong">{wrong}</p>' if self.verdict else ""]
        parts += [f"<p><b>{html.escape(self.heading)}</b></p>"]
        parts += [f'<div class="scroll">{self.shown.to_html(index=False, border=0)}</div>']
        return "".join([*parts, f"<p>{html.escape(NOTE)}</p>"])

    def plot(self, fault: str | None = None) -> Figure:
        """Return a figure: the return under each fault, and over time under one.

        Args:
            fault: of the second panel; None: the one in which the first correction changes most.
        """
        if fault is None:
            mine = self.table[self.table["method"] == self.methods[:2][-1]]
            fault = mine.loc[mine["difference"].abs().idxmax(), "fault"]
        check_choice("plot: fault", fault, self.faults)
        figure = style.new_figure(10.0, 1.2 + 0.36 * max(8, len(self.faults)))
        bars, lines = figure.subplots(1, 2)
        looks, count = style.method_styles(map(_named, self.methods)), len(self.methods)
        for place, (method, look) in enumerate(zip(self.methods, looks.values(), strict=True)):
            mine = self.table[self.table["method"] == method]
            at = np.arange(len(mine)) + 0.8 * ((place + 0.5) / count - 0.5)
            bars.barh(at, mine["return"], 0.75 / count, color=look.color, label=_named(method))
            ends = mine[["return_low", "return_high"]].to_numpy().T
            bars.hlines(at, *ends, color=style.NOMINAL, linewidth=1.0)
            rows = self.faults.index(fault) * len(self.seeds) + np.arange(len(self.seeds))
            over_time = self.played[method].rewards[:, rows].cumsum(0).mean(1)
            look.line(lines, np.arange(1, self.steps + 1), over_time, gid="return")
        healthy = self.played["none"].rewards[:, : len(self.seeds)]
        bars.axvline(healthy[self.at :].sum(0).mean(), **style.REFERENCE)
        lines.plot(np.arange(1, self.steps + 1), healthy.cumsum(0).mean(1), **style.REFERENCE)
        lines.axvline(self.at, color=style.FAINT, linewidth=0.8)
        ends = {"xycoords": lines.get_xaxis_transform(), "textcoords": "offset points"}
        lines.annotate("fault", (self.at, 1), (3, -3), fontsize=style.SMALL, va="top", **ends)
        bars.set_yticks(range(len(self.faults)), map(style.literal, self.faults))
        bars.invert_yaxis()
        style.dress(bars, "return from the fault on", size=style.NORMAL)
        style.dress(lines, "step", f"return so far: {fault}", size=style.NORMAL)
        style.legend_above(figure, *bars.get_legend_handles_labels())
        style.footnote(figure, self.footnote)
        return figure

    def save(self, folder: str | Path) -> None:
        """Write ``table.csv``, ``episodes.csv``, ``comparison.png`` and the page ``index.html``.

        Args:
            folder: made if it is not there; files of these names are replaced.
        """
        folder, picture = Path(folder), style.png_bytes(self.plot())
        title = "Returns by fault, and over time"
        page = render_page(
            title=self.title,
            summary=self.heading,
            notes=[f"The model is wrong. {self.verdict}"] if self.verdict else [],
            figures=[Picture("comparison", title, self.footnote, picture)],
            tables=[
                Table("comparison", "Without and with a correction", NOTE, self.table, self.shown)
            ],
            references=[],
        )
        write_whole(folder / "table.csv", csv_text(self.table).encode())
        write_whole(folder / "episodes.csv", csv_text(self.episodes).encode())
        write_whole(folder / "comparison.png", picture)
        write_whole(folder / "index.html", page.encode())


def share_of(episodes: pd.DataFrame, baseline: str = "none") -> pd.Series:
    """Return which share of the healthy return episodes have after the fault.

    0 is a return of 0 or, if rewards are costs, the lowest mean without a correction.

    Args:
        episodes: with columns ``fault``, ``method`` and ``after``.
        baseline: the method without a correction.

    >>> rows = [("none", "none", 8.0), ("half", "none", 2.0), ("half", "AFM", 6.0)]
    >>> share_of(pd.DataFrame(rows, columns=["fault", "method", "after"])).tolist()
    [1.0, 0.25, 0.75]
    """
    alone = episodes[episodes["method"] == baseline]
    means = alone.groupby("fault", observed=True)["after"].mean()
    healthy = means["none"]
    lost = min(means.min(), 2 * healthy) if healthy < 0 else 0.0
    return (episodes["after"] - lost) / (healthy - lost)


def _named(method: str) -> str:
    """Return a method as figures name it."""
    return {"none": "without AFM", "AFM": "with AFM"}.get(method, method)
