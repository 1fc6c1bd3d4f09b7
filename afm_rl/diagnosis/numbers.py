"""What was found, in the units of the log, with intervals over all likely explanations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.changes import Channel, Part
from afm_rl.diagnosis.checks import travel
from afm_rl.diagnosis.findings import Actuator, interval
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
from afm_rl.diagnosis.response import keep_of
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


def numbers_of(scaled: Scaled, channel: Channel, part: Part) -> Actuator:
    """Return the numbers of a part in the units of the log, by a channel without lost rows."""
    log, reach, spread = scaled.raw, scaled.reach, scaled.spread
    j, settings = channel.j, channel.settings
    model, shape = part.model, part.model.shape
    problem = channel.problem_in(part.rows, part.lead, settings.refined)
    unit = reach[model.driver]
    scale = spread[j] / unit
    command = log.command[:, model.driver]
    low, high = map(float, ends_of(command))
    middle = 0.5 * (low + high)
    intervals = likely_intervals(problem, model, middle / unit)
    extra = dict(zip(model.others, model.gains, strict=True))
    taken_in = {i: g / reach[i] for i, g in extra.items() if i >= 0}  # of other commands
    usual = sum(g * middle_of(ends_of(log.command[:, i])) for i, g in taken_in.items())
    gain, offset = model.gain * scale, (model.offset + usual) * spread[j]
    gains, offsets = intervals[0] * scale, (intervals[1] + usual) * spread[j]
    level, levels = offset + gain * middle, (intervals[2] + usual) * spread[j]
    away = np.abs(log.response[part.rows, j] - command[part.rows])
    held = command[part.rows].std() < 0.1 * unit and away.max() < settings.matters * unit
    if held:  # as a healthy one would
        gain, offset, gains, offsets = 1.0, 0.0, np.ones(2), np.zeros(2)
        level, levels = middle, np.full(2, middle)
    residual = model.residual(problem)
    rows = part.rows[channel.problem(part.lead).use[part.rows]]
    whole = (scaled.log.response[:, j] - channel.predict(part))[rows]
    total = float(scaled.log.response[rows, j].var())
    unexplained = min(float(whole.var()) / total, 1.0) if total > FLOOR else 0.0
    unexplained *= not held
    noticed = residual.var() > 0.005 * total and not held
    pattern, share = find_pattern(problem, model) if noticed else ("", 0.0)
    coupling = {log.names[i]: float(g * spread[j]) for i, g in taken_in.items()}
    largest = max(coupling, key=lambda name: abs(coupling[name]), default=None)
    dead_zone = shape.dead_zone or shape.jump
    for end, beyond, sign in ((shape.low, low, 1), (-shape.high, -high, -1)):
        if 0 < end < math.inf and -0.1 * end * unit < beyond and not middle_of((low, high)):
            # One direction only: what is not followed are the small commands.
            shift = sign * gain * end * unit
            dead_zone, offset, offsets = end, offset + shift, offsets + shift
    limits = (shape.low, shape.high, -shape.cut, shape.cut)
    ends = [end * unit for end in limits if math.isfinite(end) and abs(end) != dead_zone]
    drift = {}
    for name, kind, value, size in (
        ("gain", GAIN_DRIFT, gain, scale),
        ("offset", OFFSET_DRIFT, offset, spread[j]),
    ):
        if kind in extra:
            change = extra[kind] * size
            drift[name] = interval(value - change / 2, value + change / 2)
    return Actuator(
        name=log.names[j],
        gain=float(gain),
        gain_interval=interval(*gains),
        gain_down=float((model.gain + extra[DOWN]) * scale) if DOWN in extra else None,
        reversed=bool(gains[1] < 0 and model.gain + extra.get(DOWN, 0.0) < 0),
        offset=float(offset),
        offset_interval=interval(*offsets),
        level=float(level),
        level_interval=interval(*levels),
        dead_zone=float(dead_zone * unit),
        limits=interval(min(ends), max(ends)) if ends else None,
        switches=len(ends) > 1 and _switches(command[part.rows], min(ends), max(ends), unit),
        backlash=float(shape.play * unit),
        stick=float(shape.stick * unit),
        rate=float(abs(gain) * shape.rate * unit / log.step) if shape.rate < math.inf else None,
        every=shape.hold,
        delay_s=shape.delay * log.step,
        time_interval=interval(*intervals[3] * log.step),
        lag_s=shape.lag * log.step,
        driven_by=log.names[model.driver] if model.driver != j else largest,
        coupling=coupling,
        noise=float(residual.std() * spread[j]),
        unexplained=unexplained,
        pattern=pattern,
        misfit=share * unexplained,
        command_range=(low, high),
        drift=drift,
        travel=np.inf if log.computed or len(part) < len(log) else travel(log, j, least=0.3),
        rows=len(part),
    )


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
