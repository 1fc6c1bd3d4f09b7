"""A diagnosis on the terminal, as JSON, and as a page with a figure per actuator."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from afm_rl.diagnosis import Actuator, Diagnosis, Log
from afm_rl.replay import Table as Replayed
from afm_rl.report import style
from afm_rl.report.figures import Picture
from afm_rl.report.replay import errors_table, pictures_of
from afm_rl.report.tables import WIDE, Table
from afm_rl.report.write import render_page
from afm_rl.storage.files import write_whole

LOOKS = {"healthy": "green", "changed": "bold red", "dead": "bold red", "cannot tell": "yellow"}
LOOKS |= {"not measured": "yellow", "not actuated": "yellow"}
CAPTION = (
    "Left: an excerpt of command, response and fit. Middle: response against command; the line is "
    "a healthy actuator. Right: what the fit leaves, over the whole log."
)
NOTE = (
    "95 % intervals in brackets. Gain: response per command. Offset, noise: in units of the "
    "response. Dead zone, saturation, backlash, rate: in units of the command."
)
KEPT = ("actuator", "status", "gain", "offset", "delay (s)", "noise", "unexplained (%)")


def print_diagnosis(diagnosis: Diagnosis, file: IO[str] | None = None) -> None:
    """Print the table of actuators, notes, and one sentence for each.

    >>> wrist = Actuator(name="wrist", status="healthy", gain=1.0, gain_interval=(0.98, 1.02),
    ...                  offset=0.0, noise=0.01, unexplained=0.001, sentence="wrist: healthy")
    >>> print_diagnosis(Diagnosis(actuators=(wrist,)))  # doctest: +NORMALIZE_WHITESPACE
    <BLANKLINE>
     actuator  status   gain               offset  delay (s)  noise  unexplained (%)
     ───────────────────────────────────────────────────────────────────────────────
     wrist     healthy  1.00 [0.98, 1.02]  0       0          0.01   0.1
    <BLANKLINE>
    wrist: healthy
    """
    console = Console(file=file, width=WIDE, highlight=False)
    grid = Grid(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    shown = _table(diagnosis)
    shown = shown.loc[:, [name for name in shown if name in KEPT or (shown[name] != "-").any()]]
    for head in shown:
        grid.add_column(Text(head))
    for actuator, texts in zip(diagnosis.actuators, shown.to_numpy(), strict=True):
        look = LOOKS[actuator.status]
        grid.add_row(*(Text(text, look if k < 2 else "") for k, text in enumerate(texts)))
    console.print(grid)
    for note in diagnosis.notes:
        console.print(Text(f"Note: {note}"))
    for actuator in diagnosis.actuators:
        console.print(Text(actuator.sentence), soft_wrap=True)


def _table(diagnosis: Diagnosis) -> pd.DataFrame:
    """Return the numbers as text, a dash where there is none."""
    return pd.DataFrame(
        {
            "actuator": a.name,
            "status": a.status,
            "gain": _with_interval(a.gain, a.gain_interval),
            "offset": _text(a.offset),
            "dead zone": _text(a.dead_zone or None),
            "saturation": _text(a.saturation),
            "backlash": _text(a.backlash or None),
            "rate (1/s)": _text(a.rate),
            "delay (s)": _text(a.delay_s),
            "lag (s)": _text(a.lag_s or None),
            "driven by": a.driven_by or "-",
            "changed at (s)": ", ".join(_text(change.t) for change in a.changes) or "-",
            "noise": _text(a.noise),
            "unexplained (%)": _text(100 * a.unexplained, 2),
        }
        for a in diagnosis.actuators
    )


def _text(value: float | None, digits: int = 3) -> str:
    """Return a number as text.

    >>> _text(0.12345), _text(None), _text(-0.0)
    ('0.123', '-', '0')
    """
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value + 0.0:.{digits}g}"


def _with_interval(value: float, interval: tuple[float, float]) -> str:
    width = 0.5 * (interval[1] - interval[0])
    if not math.isfinite(value):
        return "-"
    if not math.isfinite(width):
        return f"{_text(value)} [-, -]"
    digits = 2 if not width > 0 else min(max(2, -math.floor(math.log10(width))), 6)
    return f"{value:.{digits}f} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"


def write_diagnosis(
    diagnosis: Diagnosis,
    log: Log,
    out: Path,
    source: str,
    page: bool = True,
    replayed: Replayed | None = None,
) -> Iterator[Path]:
    """Write ``diagnosis.json`` and ``index.html``; yield their paths as they are written.

    Args:
        diagnosis: what to write.
        log: what it was made from.
        out: folder; made if it is not there.
        source: what the log is called.
        page: write the page, too.
        replayed: the same log replayed, for the page.

    Raises:
        ConfigurationError: if a file cannot be written.
    """
    text = json.dumps(diagnosis.as_dict(), indent=2, ensure_ascii=False)
    write_whole(out / "diagnosis.json", text.encode())
    yield out / "diagnosis.json"
    if page:
        write_whole(out / "index.html", _page(diagnosis, log, source, replayed).encode())
        yield out / "index.html"


def _page(diagnosis: Diagnosis, log: Log, source: str, replayed: Replayed | None) -> str:
    shown = _table(diagnosis)
    tables = [Table("actuators", "All actuators", NOTE, shown, shown)]
    figures = [
        Picture(
            str(place),
            actuator.sentence,
            CAPTION,
            style.png_bytes(draw_actuator(diagnosis, log, place)),
        )
        for place, actuator in enumerate(diagnosis.actuators)
    ]
    summary = (
        f"{diagnosis.rows} rows of {len(diagnosis.actuators)} actuators, a row every "
        f"{diagnosis.step_s:.4g} s, from {source}."
    )
    notes = [*diagnosis.notes, *(actuator.sentence for actuator in diagnosis.actuators)]
    if replayed is not None:
        tables.append(errors_table(replayed))
        figures += list(pictures_of(replayed))
        notes += [replayed.sentence, *replayed.notes]
    content = {"title": "Diagnosis of the actuators", "summary": summary, "notes": notes}
    return render_page(**content, figures=figures, tables=tables, references=[])


def draw_actuator(diagnosis: Diagnosis, log: Log, place: int, points: int = 3000) -> Figure:
    """Return the figure of one actuator: an excerpt, response against command, and residual.

    The latter two have ``points`` dots at most.
    """
    actuator = diagnosis.actuators[place]
    driver = _driver(actuator, log, place)
    u, y = log.command[:, driver], log.response[:, place]
    fit = y if diagnosis.fitted is None else diagnosis.fitted[:, place]
    t = log.since
    figure = style.new_figure(10.5, 2.9)
    left, middle, right = figure.subplots(1, 3, width_ratios=[2.1, 1.1, 1.5])
    rows = _excerpt(actuator, t)
    label = "command" if driver == place else f"command of {log.names[driver]}"
    left.step(t[rows], u[rows], where="post", color=style.FAINT, linewidth=1.0, label=label)
    left.plot(t[rows], y[rows], color=style.COLOURS[0], linewidth=1.4, label="response")
    fitted = {"color": style.REGIME, "linewidth": 1.1, "linestyle": (0, (4, 1.5))}
    left.plot(t[rows], fit[rows], label="fit", **fitted)
    some = np.unique(np.linspace(0, len(t) - 1, min(points, len(t))).astype(int))
    dots = {"s": 3, "linewidths": 0, "rasterized": True}
    middle.scatter(u[some], y[some], color=style.COLOURS[0], alpha=0.35, **dots)
    ends = np.array(actuator.command_range)
    middle.plot(ends, actuator.unit * ends, color=style.NOMINAL, linewidth=1.0)
    right.scatter(t[some], (y - fit)[some], color=style.FAINT, alpha=0.5, **dots)
    for change in actuator.changes:
        for axes in (left, right):
            if axes is right or t[rows][0] <= change.t <= t[rows][-1]:
                axes.axvline(change.t, color=style.REGIME, linewidth=1.0, linestyle=":")
    labels = (("t (s)", ""), ("command", "response"), ("t (s)", "residual"))
    for axes, (below, beside) in zip((left, middle, right), labels, strict=True):
        style.dress(axes, below, beside, "both")
    style.legend_above(figure, *left.get_legend_handles_labels())
    return figure


def _driver(actuator: Actuator, log: Log, place: int) -> int:
    """Return which command to draw: that of another actuator where this alone is followed."""
    other = actuator.driven_by
    return place if other is None or other in actuator.coupling else log.names.index(other)


def _excerpt(actuator: Actuator, t: np.ndarray, most: int = 300) -> slice:
    """Return rows around the last change, or the first ones."""
    middle = int(np.searchsorted(t, actuator.changes[-1].t)) if actuator.changes else 0
    first = max(0, min(middle - most // 2, len(t) - most))
    return slice(first, first + most)
