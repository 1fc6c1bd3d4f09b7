"""Lines, markers and sizes that all figures share.

Each method has the colour of :mod:`afm_rl.method_colours`; line styles and markers say the same
again in greyscale. A figure shows at most as many methods as there are colours. Figures are built
on matplotlib's objects, so no window opens and no global figure is left behind.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D

from afm_rl.film import sheet
from afm_rl.method_colours import COLOURS, colour_of, places_of
from afm_rl.report.runs import with_scenarios

Look = dict[str, Any]
DPI = 150
SMALL, NORMAL, LARGE = 8.0, 9.0, 10.0  # font sizes (pt)
NOMINAL, REGIME, BAND = "#222222", "#d55e00", "#e69f00"  # before and after; under the regime
FAINT, GOOD, ROAD = "#888888", "#009e73", "#e4e4e4"
AFM, WITHOUT_AFM, ORACLE = map(colour_of, ("AFM", "without AFM", "oracle"))

FEW = 6  # methods in a figure
LINES: tuple[Any, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (1.2, 1)),
    (0, (6, 1.5, 1.2, 1.5)),
    "-",
    (0, (3, 1)),
    (0, (8, 2)),
    (0, (4, 1, 1, 1, 1, 1)),
)
MARKERS = "osD^vPX*"

BEFORE: Look = {"color": NOMINAL, "linewidth": 1.1}  # a path, and its stretch under the regime
CHANGED: Look = {"color": REGIME, "linewidth": 1.6}
BROAD: Look = {"color": BAND, "linewidth": 8.0, "alpha": 0.35}
REFERENCE: Look = {"color": FAINT, "linestyle": ":", "linewidth": 1.2}
POINT: Look = {"linestyle": "", "markeredgewidth": 1.0}
START = POINT | {"marker": "o", "color": "white", "markeredgecolor": "black", "markersize": 6}
FINISHED = POINT | {"marker": "o", "color": GOOD, "markeredgecolor": "white", "markersize": 10}
TICK = POINT | {"marker": r"$\checkmark$", "color": "white", "markeredgewidth": 0, "markersize": 5}
GIVEN_UP = POINT | {"marker": "X", "color": "black", "markeredgecolor": "white", "markersize": 9}
TARGET: Look = {"marker": "*", "color": GOOD, "markersize": 13, "linestyle": ""}
PLANNED: Look = {"color": "#0072b2", "linewidth": 6.0}  # actions
EXECUTED: Look = {"color": "#cc79a7", "linewidth": 2.5}


class Style(NamedTuple):
    """How one method is drawn in every figure."""

    color: str
    linestyle: Any
    marker: str
    place: int = 0
    """Which one of a figure's methods it is."""

    @property
    def width(self) -> float:
        """Width of its lines: later ones are thinner, so that earlier ones show on both sides."""
        return 2.6 - 0.3 * self.place

    def line(self, axes: Axes, x: Any, y: Any, gid: str, **look: Any) -> Line2D:
        """Draw a line that can be told from others on the same points.

        The markers of different methods stand in different places, three or four on each line.
        """
        apart = 0.28 * len(x)
        first = int(0.02 * len(x) + apart * self.place / FEW)
        (line,) = axes.plot(x, y, color=self.color, linestyle=self.linestyle, linewidth=self.width)
        line.set(marker=self.marker, markersize=5.0, markeredgecolor="white", markeredgewidth=0.5)
        line.set(markevery=(first, max(1, int(apart))), gid=gid, **look)
        return line

    def handle(self) -> Line2D:
        """Return what stands for the method in a legend."""
        look: Look = {"color": self.color, "linestyle": self.linestyle}
        return Line2D([], [], marker=self.marker, markersize=5, linewidth=1.7, **look)


def method_styles(methods: Iterable[str]) -> dict[str, Style]:
    """Return a style for each method, by order of first occurrence.

    >>> styles = method_styles(["oracle", "afm_physics", "oracle"])
    >>> list(styles), styles["afm_physics"].color
    (['oracle', 'afm_physics'], '#0072b2')
    """
    looks = list(zip(COLOURS, LINES, MARKERS, strict=True))
    places = places_of(methods)
    return {
        method: Style(*looks[look], k % len(looks))
        for k, (method, look) in enumerate(places.items())
    }


def depth_of(method: str) -> int:
    """Return where a method is drawn: AFM on top (0), then others (1), an oracle below (2).

    >>> sorted(["oracle", "physics", "afm_physics"], key=depth_of)
    ['afm_physics', 'physics', 'oracle']
    """
    return {AFM: 0, ORACLE: 2}.get(colour_of(method), 1)


def groups_of_methods(methods: Iterable[str]) -> list[list[str]]:
    """Return the methods of each figure, where there are more than one can show.

    >>> [len(group) for group in groups_of_methods("abcdefgh")]
    [4, 4]
    """
    names = list(dict.fromkeys(methods))
    pages = -(-len(names) // FEW)
    size = -(-len(names) // max(pages, 1))
    return [names[first : first + size] for first in range(0, len(names), size or 1)]


def excerpt(missions: pd.DataFrame, scenarios: int) -> tuple[pd.DataFrame, dict[str, Style], str]:
    """Return what a figure shows of some missions.

    Returns:
        The first mission of each method and scenario, of the first six methods; how these methods
        are drawn; and a sentence on what is left out.
    """
    first = with_scenarios(missions).drop_duplicates(["method", "scenario"])
    names = list(dict.fromkeys(missions["method"]))[:FEW]
    chosen = first["scenario"].isin(first["scenario"].unique()[:scenarios]) & first["method"].isin(
        names
    )
    missing = len(missions) - chosen.sum()
    note = f"{missing} of {len(missions)} missions not shown" if missing else ""
    return first[chosen], method_styles(names), note


def new_figure(width: float, height: float, dpi: int = DPI) -> Figure:
    """Return an empty white figure of ``width`` by ``height`` inches."""
    return sheet(width, height, dpi, layout="constrained", facecolor="white")


def dress(axes: Any, x: str = "", y: str = "", lines: Any = None, size: float = SMALL) -> None:
    """Give axes the common look: small ticks, a light frame, labels, faint lines behind all."""
    axes.tick_params(which="both", labelsize=SMALL, length=2.5, color=FAINT)
    axes.tick_params(which="minor", length=1.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    for label, write in ((x, axes.set_xlabel), (y, axes.set_ylabel)):
        if label:
            write(literal(label), fontsize=size)
    if lines:
        axes.grid(axis=lines, color="#eeeeee", linewidth=0.6)
        axes.set_axisbelow(True)


def legend_above(
    figure: Figure, handles: Sequence[Any], labels: Sequence[str], title: str | None = None
) -> None:
    """Explain the lines above all axes, in one row if they fit into it."""
    room = [0.48 + 0.062 * len(label) for label in labels]  # inches, at the small font size
    width = figure.get_figwidth()
    columns = len(labels) if sum(room) <= width else max(1, int(width / max(room)))
    figure.legend(
        handles,
        [literal(label) for label in labels],
        loc="outside upper center",
        ncols=columns,
        title=title if title is None else literal(title),
        title_fontsize=LARGE,
        fontsize=SMALL,
        frameon=False,
        columnspacing=1.5,
        handler_map={tuple: HandlerTuple(ndivide=1)},
    )


def footnote(figure: Figure, text: str) -> None:
    """Write at the foot of the figure what a reader must know of it, if anything."""
    if text:
        figure.supxlabel(literal(text), fontsize=SMALL, color="#555555")


def literal(text: str) -> str:
    r"""Return ``text`` so that matplotlib takes no part of it for a formula.

    >>> print(literal("a$b$"))
    a\$b\$
    """
    return text.replace("$", r"\$")


def png_bytes(figure: Figure) -> bytes:
    """Return the figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()
