"""A diagnosis, and a replayed log, in a terminal, as files, and as a page with figures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.text import Text

from afm_rl.diagnosis import Actuator, Calibration, Diagnosis, Log
from afm_rl.diagnosis.calibration import Estimate
from afm_rl.diagnosis.replay import Replayed
from afm_rl.diagnosis.replay.table import SHARES
from afm_rl.report import style
from afm_rl.report.figures import Picture
from afm_rl.report.tables import Table, grid_of, terminal
from afm_rl.report.write import render_page
from afm_rl.storage.files import csv_text, write_whole

LOOKS = {"healthy": "green", "changed": "bold red", "dead": "bold red", "cannot tell": "yellow"}
LOOKS |= {"not measured": "yellow", "not actuated": "yellow"}


def print_diagnosis(diagnosis: Diagnosis, file: IO[str] | None = None) -> None:
    """Print the table of actuators, notes, and one sentence for each.

    >>> wrist = Actuator(name="wrist", status="healthy", gain=1.0, gain_interval=(0.98, 1.02),
    ...                  offset=0.0, noise=0.01, unexplained=0.001, sentence="wrist: healthy")
    >>> found = Diagnosis(actuators=(wrist,), step_s=0.02)
    >>> print_diagnosis(found)  # doctest: +NORMALIZE_WHITESPACE
    <BLANKLINE>
     actuator  status   gain               offset  delay (s)  noise  unexplained (%)
     ───────────────────────────────────────────────────────────────────────────────
     wrist     healthy  1.00 [0.98, 1.02]  0       0          0.01   0.1
    <BLANKLINE>
    wrist: healthy
    """
    console, shown = terminal(file), _table(diagnosis)
    always = ["actuator", "status", "gain", "offset", "noise", "unexplained (%)"]
    always.append(f"delay ({_unit_of_time(diagnosis)})")
    shown = shown.loc[:, [name for name in shown if name in always or (shown[name] != "-").any()]]
    looks = [LOOKS[actuator.status] for actuator in diagnosis.actuators]
    console.print(grid_of(shown, lambda row, column: looks[row] if column < 2 else ""))
    for note in diagnosis.notes:
        console.print(Text(f"Note: {note}"))
    for actuator in diagnosis.actuators:
        console.print(Text(actuator.sentence), soft_wrap=True)


def _table(diagnosis: Diagnosis) -> pd.DataFrame:
    """Return the numbers as text, a dash where there is none."""
    time = _unit_of_time(diagnosis)
    return pd.DataFrame(
        {
            "actuator": a.name,
            "status": a.status,
            "gain": _with_interval(a.gain, a.gain_interval),
            "offset": _text(a.offset),
            "dead zone": _text(a.dead_zone or None),
            "saturation": _text(a.saturation),
            "backlash": _text(a.backlash or None),
            f"rate (1/{time})": _text(a.rate),
            f"delay ({time})": _text(a.delay_s),
            f"lag ({time})": _text(a.lag_s or None),
            "driven by": a.driven_by or "-",
            f"changed at ({time})": ", ".join(_text(change.t) for change in a.changes) or "-",
            "noise": _text(a.noise),
            "unexplained (%)": _text(100 * a.unexplained, 2),
        }
        for a in diagnosis.actuators
    )


def _unit_of_time(diagnosis: Diagnosis) -> str:
    """Return s, or rows where no time was logged."""
    return "s" if diagnosis.step_s != 1.0 else "rows"


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
    calibration: Calibration | None = None,
) -> Iterator[Path]:
    """Write ``diagnosis.json`` and ``index.html``; yield their paths as they are written."""
    text = json.dumps(diagnosis.as_dict(), indent=2, ensure_ascii=False)
    write_whole(out / "diagnosis.json", text.encode())
    yield out / "diagnosis.json"
    if page:
        write_whole(
            out / "index.html", _page(diagnosis, log, source, replayed, calibration).encode()
        )
        yield out / "index.html"


def calibration_table(calibration: Calibration, frames: bool = False) -> Table:
    """Return the numbers of each joint with their intervals; those not determined in brackets.

    Of a data set of ``frames``, the delay in these, and the gain of first order: the share of the
    way to its command that a joint goes in a frame.
    """
    step, time = calibration.step, calibration.time
    rows = []
    for joint in calibration.joints:
        row = {"joint": joint.name}
        if frames:
            row["delay (frames)"] = _estimate_text(joint.delay, lambda x: x / step)
            row["gain per frame"] = _estimate_text(joint.lag, lambda x: -math.expm1(-step / x))
            row["offset"] = _estimate_text(joint.offset)
        else:
            names = ("sign", "scale", "offset", "dead_zone", "delay", "lag", "rate")
            heads = {"delay": f"delay ({time})", "lag": f"lag ({time})", "rate": f"rate (1/{time})"}
            row |= {
                heads.get(name, name.replace("_", " ")): _estimate_text(getattr(joint, name))
                for name in names
            }
            row["command for u"] = joint.undo
        rows.append(row)
    note = "95 % intervals in brackets; ? where a number is not well determined."
    shown = pd.DataFrame(rows)
    return Table("calibration", "Calibration", note, shown, shown)


def _estimate_text(estimate: Estimate, of: Callable[[float], float] = float) -> str:
    """Return a number with its interval, through a function that is monotonic.

    >>> _estimate_text(Estimate(0.1, (0.0, 0.2), False), lambda x: -math.expm1(-0.1 / x))
    '0.63 [0.39, 1.00] ?'
    """

    def value(x: float) -> float:
        return of(max(x, 1e-300) if x == 0.0 else x) + 0.0

    ends = sorted(value(end) for end in estimate.interval)
    unsure = "" if estimate.determined else " ?"
    return f"{_with_interval(value(estimate.value), (ends[0], ends[1]))}{unsure}"


def _page(
    diagnosis: Diagnosis,
    log: Log,
    source: str,
    replayed: Replayed | None,
    calibration: Calibration | None,
) -> str:
    shown = _table(diagnosis)
    note = (
        "95 % intervals in brackets. Gain: response per command. Offset, noise: in units of the "
        "response. Rate: of these a second. Dead zone, saturation, backlash: of the command."
    )
    tables = [Table("actuators", "All actuators", note, shown, shown)]
    caption = (
        "Left: an excerpt of command, response and fit. Middle: response against command; the line "
        "is a healthy actuator. Right: residual of the fit, over the whole log."
    )
    if calibration is not None:
        tables.append(calibration_table(calibration))
    figures = []
    for place, actuator in enumerate(diagnosis.actuators):
        png = style.png_bytes(draw_actuator(diagnosis, log, place))
        figures.append(Picture(str(place), actuator.sentence, caption, png))
    every = f", a row every {diagnosis.step_s:.4g} s" if _unit_of_time(diagnosis) == "s" else ""
    summary = (
        f"{diagnosis.rows} rows of {len(diagnosis.actuators)} actuators{every}, from {source}."
    )
    notes = [*diagnosis.notes, *(actuator.sentence for actuator in diagnosis.actuators)]
    if replayed is not None:
        tables.append(errors_table(replayed))
        notes += [replayed.sentence, *replayed.notes]
    content = {"title": "Diagnosis of the actuators", "summary": summary, "notes": notes}
    return render_page(**content, figures=figures, tables=tables, references=[])


def draw_actuator(diagnosis: Diagnosis, log: Log, place: int, points: int = 3000) -> Figure:
    """Return the figure of one actuator: an excerpt, response against command, and residual.

    The latter two have ``points`` dots at most.
    """
    actuator = diagnosis.actuators[place]
    other = actuator.driven_by  # drawn where this alone is followed
    driver = place if other is None or other in actuator.coupling else log.names.index(other)
    u, y = log.command[:, driver], log.response[:, place]
    fit = y if diagnosis.fitted is None else diagnosis.fitted[:, place]
    t = log.since
    figure = style.new_figure(10.5, 2.9)
    left, middle, right = figure.subplots(1, 3, width_ratios=[2.1, 1.1, 1.5])
    rows = _excerpt(actuator, t)
    label = "command" if driver == place else f"command of {log.names[driver]}"
    left.step(t[rows], u[rows], where="post", color=style.FAINT, linewidth=1.0, label=label)
    left.plot(t[rows], y[rows], color=style.COLOURS[0], linewidth=2.2, label="response")
    fitted = {"color": style.REGIME, "linewidth": 0.9}
    left.plot(t[rows], fit[rows], label="fit", **fitted)
    dotted = np.unique(np.linspace(0, len(t) - 1, min(points, len(t))).astype(int))
    dots = {"s": 3, "linewidths": 0, "rasterized": True}
    middle.scatter(u[dotted], y[dotted], color=style.COLOURS[0], alpha=0.35, **dots)
    ends = np.array(actuator.command_range)
    middle.plot(ends, actuator.unit * ends, color=style.NOMINAL, linewidth=1.0)
    right.scatter(t[dotted], (y - fit)[dotted], color=style.FAINT, alpha=0.5, **dots)
    for change in actuator.changes:
        for axes in (left, right):
            if axes is right or t[rows][0] <= change.t <= t[rows][-1]:
                axes.axvline(change.t, color=style.REGIME, linewidth=1.0, linestyle=":")
    time = f"t ({_unit_of_time(diagnosis)})"
    labels = ((time, ""), ("command", "response"), (time, "residual"))
    for axes, (below, beside) in zip((left, middle, right), labels, strict=True):
        style.dress(axes, below, beside, "both")
    style.legend_above(figure, *left.get_legend_handles_labels())
    return figure


def _excerpt(actuator: Actuator, t: np.ndarray, most: int = 300) -> slice:
    """Return rows around the last change, or the first ones."""
    middle = int(np.searchsorted(t, actuator.changes[-1].t)) if actuator.changes else 0
    first = max(0, min(middle - most // 2, len(t) - most))
    return slice(first, first + most)


def print_replay(replayed: Replayed, file: IO[str] | None = None) -> None:
    """Print the errors over the whole log, and what a correction would have done.

    >>> from afm_rl.diagnosis import Log
    >>> from afm_rl.diagnosis.replay.table import AFM, ALONE, errors_of
    >>> u = np.linspace(-1, 1, 40)[:, None]
    >>> log, found = Log(("pan",), u, 0.5 * u), {ALONE: u, AFM: 0.5 * u}
    >>> table = Replayed(log, found, 0 * u, errors_of(log, found), {"pan": 1.0})
    >>> print_replay(table)  # doctest: +NORMALIZE_WHITESPACE
    <BLANKLINE>
     actuator  error   as commanded       AFM
     ──────────────────────────────────────────────────────
     pan       median  0.26 [0.01, 0.50]  0.00 [0.00, 0.00]
     pan       p90     0.45 [0.37, 0.50]  0.00 [0.00, 0.00]
    <BLANKLINE>
    A correction would have removed 100 % of the error of pan.
    """
    console = terminal(file)
    console.print(grid_of(errors_table(replayed, stretches=False).shown))
    for line in (replayed.sentence, *replayed.notes):
        console.print(Text(line), soft_wrap=True)


def errors_table(replayed: Replayed, stretches: bool = True) -> Table:
    """Return the errors, a column for each predictor: of stretches of time, or over all."""
    errors = replayed.errors
    if not stretches:
        errors = errors[errors["stretch"] == "all"]
    rows = []
    for (name, _), stretch in errors.groupby(["actuator", "stretch"], sort=False):
        first = stretch.iloc[0]
        for kind in SHARES:
            row = {"actuator": name}
            if stretches:
                row["t (s)"] = f"{first['from']:.6g} to {first['to']:.6g}"
            row["error"] = kind
            for _, predicted in stretch.iterrows():
                ends = predicted[f"{kind}_low"], predicted[f"{kind}_high"]
                row[predicted["predictor"]] = _with_interval(predicted[kind], ends)
            rows.append(row)
    note = (
        "Absolute error of the prediction of each row from its command and earlier rows: "
        "median and 90th percentile with 95 % intervals, in units of the response."
    )
    return Table("errors", "Error of predictions", note, errors, pd.DataFrame(rows))


def write_replay(replayed: Replayed, out: Path) -> Path:
    """Write a row for each row of the log as CSV."""
    write_whole(out, csv_text(replayed.rows()).encode())
    return out
