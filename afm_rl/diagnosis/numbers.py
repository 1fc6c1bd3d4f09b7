"""What was found, in the units of the log, with intervals over all likely explanations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from afm_rl.diagnosis.changes import Channel, Part
from afm_rl.diagnosis.checks import travel
from afm_rl.diagnosis.findings import Actuator, Interval, interval
from afm_rl.diagnosis.fit import larger
from afm_rl.diagnosis.model import (
    DOWN,
    FLOOR,
    GAIN_DRIFT,
    OFFSET_DRIFT,
    Model,
    Problem,
    lost,
    rows_of,
)
from afm_rl.diagnosis.readers.telemetry import listed
from afm_rl.diagnosis.refine import interval_widths, refine
from afm_rl.diagnosis.residuals import find_pattern
from afm_rl.diagnosis.response import Shape, keep_of
from afm_rl.diagnosis.scale import Scaled, ends_of, middle_of
from afm_rl.diagnosis.settings import Settings


def likely_intervals(problem: Problem, model: Model, middle: float) -> np.ndarray:
    """Return the 95 % intervals of the gain, of two responses, and of the time they take.

    ``(4, 2)``: the responses are those to the commands 0 and ``middle``, the time is delay and lag
    together, in steps.

    They span those of every mixture of delay and lag that explains the response about as well, and
    of a model with one number more that explains it a little better: what was left out because it
    is not sure may still be there.
    """
    rows = rows_of(problem, model)
    ends = []
    for likely in [model, *_others(problem, model)]:
        more = max(likely.size - max(model.size, 1), 0)
        if lost(rows, likely.cost, model.cost) < 4.0 - 6.0 * more:
            gain, offset = likely.gain, likely.offset
            late = max(likely.shape.delay, 0.0) + likely.shape.lag
            best = np.array([gain, offset, offset + middle * gain, late])
            widths = interval_widths(problem, likely, middle)
            ends.append([best - widths, best + widths])
    lows, highs = np.moveaxis(np.array(ends), 1, 0)
    return np.stack([lows.min(0), highs.max(0)], -1)


def _others(problem: Problem, model: Model) -> list[Model]:
    """Return other explanations: one number more, or another mixture of delay and lag."""
    if len(problem.y) > problem.settings.fitted:
        return []
    models = list(larger(problem, model))
    late = model.shape.delay + model.shape.lag
    rest = tuple(name for name in model.active if name not in ("delay", "keep"))
    for share, names in ((1.0, ["delay"]), (0.0, ["keep"]), (0.5, ["delay", "keep"])):
        keep = keep_of((1 - share) * max(late, 0.3))
        models.append(model.with_shape((*rest, *names), delay=share * late, keep=keep))
    return refine(problem, models)


class Line(NamedTuple):
    """The response to a command, in the units of the log, with the ends of 95 % intervals."""

    gain: float
    offset: float
    """At the command 0."""
    level: float
    """At the middle of the commands."""
    gains: np.ndarray
    offsets: np.ndarray
    levels: np.ndarray

    def moved(self, by: float) -> Line:
        """Return the line with another offset."""
        return self._replace(offset=self.offset + by, offsets=self.offsets + by)


def numbers_of(scaled: Scaled, channel: Channel, part: Part) -> Actuator:
    """Return the numbers of a part in the units of the log, by a channel without lost rows."""
    log, j, model, shape = scaled.raw, channel.j, part.model, part.model.shape
    unit, spread = scaled.reach[model.driver], scaled.spread[j]
    command = log.command[:, model.driver]
    low, high = interval(*ends_of(command))
    middle = 0.5 * (low + high)
    problem = channel.problem_in(part.rows, part.lead, channel.settings.refined)
    intervals = likely_intervals(problem, model, middle / unit)
    extra = dict(zip(model.others, model.gains, strict=True))
    coupling = {i: gain / scaled.reach[i] for i, gain in extra.items() if i >= 0}
    usual = sum(gain * middle_of(ends_of(log.command[:, i])) for i, gain in coupling.items())
    line = _line_of(model, intervals, usual, middle, spread, unit)
    away = np.abs(log.response[part.rows, j] - command[part.rows]).max()
    held = command[part.rows].std() < 0.1 * unit and away < channel.settings.matters * unit
    if held:  # as a healthy one would
        line = Line(1.0, 0.0, middle, np.ones(2), np.zeros(2), np.full(2, middle))
    dead_zone, shift = _one_sided(shape, line.gain, unit, low, high)
    line = line.moved(shift)
    limits = (shape.low, shape.high, -shape.cut, shape.cut)
    ends = [end * unit for end in limits if math.isfinite(end) and abs(end) != dead_zone]
    named = {log.names[i]: float(gain * spread) for i, gain in coupling.items()}
    largest = max(named, key=lambda name: abs(named[name]), default=None)
    down = model.gain + extra.get(DOWN, 0.0)
    rate = None if shape.rate == math.inf else abs(line.gain) * shape.rate * unit / log.step
    return Actuator(
        name=log.names[j],
        gain=float(line.gain),
        gain_interval=interval(*line.gains),
        gain_down=float(down * spread / unit) if DOWN in extra else None,
        reversed=bool(line.gains[1] < 0 and down < 0),
        offset=float(line.offset),
        offset_interval=interval(*line.offsets),
        level=float(line.level),
        level_interval=interval(*line.levels),
        dead_zone=float(dead_zone * unit),
        limits=interval(min(ends), max(ends)) if ends else None,
        switches=len(ends) > 1 and _switches(command[part.rows], min(ends), max(ends), unit),
        backlash=float(shape.play * unit),
        stick=float(shape.stick * unit),
        rate=None if rate is None else float(rate),
        every=shape.hold,
        delay_s=shape.delay * log.step,
        time_interval=interval(*intervals[3] * log.step),
        lag_s=shape.lag * log.step,
        driven_by=log.names[model.driver] if model.driver != j else largest,
        coupling=named,
        noise=float(model.residual(problem).std() * spread),
        **_left_over(scaled, channel, part, problem, held),
        command_range=(low, high),
        drift=_drifts(line, extra, spread / unit, spread),
        travel=np.inf if log.computed or len(part) < len(log) else travel(log, j, least=0.3),
        rows=len(part),
    )


def _line_of(
    model: Model, intervals: np.ndarray, usual: float, middle: float, spread: float, unit: float
) -> Line:
    """Return the line of a model, beside the usual response to other commands."""
    scale = spread / unit
    gain, offset = model.gain * scale, (model.offset + usual) * spread
    offsets, levels = ((intervals[k] + usual) * spread for k in (1, 2))
    return Line(gain, offset, offset + gain * middle, intervals[0] * scale, offsets, levels)


def _left_over(
    scaled: Scaled, channel: Channel, part: Part, problem: Problem, held: bool
) -> dict[str, Any]:
    """Return the share of a part's variance that is left unexplained, and what it depends on."""
    if held:
        return {"unexplained": 0.0, "pattern": "", "misfit": 0.0}
    rows = part.rows[channel.problem(part.lead).use[part.rows]]
    response = scaled.log.response[:, channel.j]
    total = float(response[rows].var())
    left = float((response - channel.predict(part))[rows].var())
    unexplained = min(left / total, 1.0) if total > FLOOR else 0.0
    noticed = part.model.residual(problem).var() > 0.005 * total
    pattern, share = find_pattern(problem, part.model) if noticed else ("", 0.0)
    return {"unexplained": unexplained, "pattern": pattern, "misfit": share * unexplained}


def _one_sided(
    shape: Shape, gain: float, unit: float, low: float, high: float
) -> tuple[float, float]:
    """Return the dead zone, and by how much it moves the offset.

    Where commands have one direction only, what is not followed are the small commands.
    """
    for end, beyond, sign in ((shape.low, low, 1), (-shape.high, -high, -1)):
        if 0 < end < math.inf and -0.1 * end * unit < beyond and not middle_of((low, high)):
            return end, sign * gain * end * unit
    return shape.dead_zone or shape.jump, 0.0


def _drifts(
    line: Line, extra: Mapping[int, float], scale: float, spread: float
) -> dict[str, Interval]:
    """Return gain and offset at begin and end of the log, where they drift."""
    drift = {}
    for name, kind, size in (("gain", GAIN_DRIFT, scale), ("offset", OFFSET_DRIFT, spread)):
        if kind in extra:
            half, value = 0.5 * extra[kind] * size, getattr(line, name)
            drift[name] = interval(value - half, value + half)
    return drift


def _switches(command: np.ndarray, low: float, high: float, reach: float) -> bool:
    """Return whether so few commands are between two limits that their size cannot count.

    >>> _switches(np.linspace(-7, 7, 50), -1.0, 1.0, 7.0), _switches(np.ones(9), -1.0, 1.0, 7.0)
    (False, True)
    """
    inside = np.unique(command[(command > low) & (command < high)])
    return bool(high - low < 0.06 * reach or len(inside) < 3 and high - low < 0.4 * reach)


def by_episode(actuator: Actuator, shift: np.ndarray, settings: Settings) -> Actuator:
    """Return an actuator whose offset in each episode is another one, by ``shift`` ``(E,)``."""
    each = actuator.offset + shift
    order, same = np.argsort(each), 2 * settings.matters * abs(actuator.gain) * actuator.reach
    alike = np.split(order, np.flatnonzero(np.diff(each[order]) > same) + 1)
    offsets = {listed(group.tolist()): float(each[group].mean()) for group in alike}
    ends = np.array([shift.min(), shift.max()])
    return replace(
        actuator,
        offsets=offsets,
        offset_interval=interval(*actuator.offset_interval + ends),
        level_interval=interval(*actuator.level_interval + ends),
    )


def quantum_of(response: np.ndarray) -> float:
    """Return the size of the steps of a response, 0 if it moves freely."""
    values = np.unique(response)
    steps = np.diff(values)
    if not 3 <= len(values) < 0.1 * len(response) or not steps.min() > 1e-6 * np.ptp(values):
        return 0.0
    size = float(np.median(steps))
    whole = steps / size
    return size if np.abs(whole - whole.round()).max() < 0.01 else 0.0
