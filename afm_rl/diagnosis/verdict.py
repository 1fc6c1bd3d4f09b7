"""A diagnosis from a log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.findings import Actuator, Change, Diagnosis
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.lost import without_lost
from afm_rl.diagnosis.model import DOWN
from afm_rl.diagnosis.parts import SEARCHED, Part, find_parts, predict, settle
from afm_rl.diagnosis.pattern import find_pattern
from afm_rl.diagnosis.search import Lead, find_leads
from afm_rl.diagnosis.words import MISFIT, UNITS, judge
from afm_rl.diagnosis.wrap import unwrapped

ALIKE = 0.1  # deviation of the median gain of all actuators from such a gain
FEW = 0.1  # share of the rows: a response with more values moves freely
EXACT = 0.01  # of a step, by which steps may differ
LOOSE = 0.1  # share of the variance: a response of which less is left follows its command
CLOSE = 0.3  # times what is left of the response: rates of change of which less is left follow
ENDLESS = 0.985  # share of the way that is left after a step: no lag, but a sum
CREEPS = 0.003  # half ranges per step: what is no faster never arrives
COPY = 0.999  # correlation of two commands that cannot be told apart


def diagnose(log: Log) -> Diagnosis:
    """Say what each actuator of a log does.

    Each response is fitted by the model of :class:`Actuator`: first lines with every delay, lag
    and command, then the numbers that its response needs, by robust nonlinear least squares.
    The log is split where an actuator changed. Intervals take residuals that depend on each other
    into account, and commands that hardly differ.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (400, 2))
    >>> y = u * [1.0, -0.5] + 0.01 * np.random.default_rng(1).standard_normal((400, 2))
    >>> print(diagnose(Log(("shoulder", "elbow"), u, y)))
    shoulder: healthy
    elbow: reversed, 50 % of the command
    """
    read, (log, turns) = log, unwrapped(log, SEARCHED)
    reach, spread = _reach(log.command), _spread(log.response)
    moved = np.ptp(log.command, axis=0) > 0
    scaled = replace(log, command=log.command / reach, response=log.response / spread)
    leads = find_leads(scaled.thinned(SEARCHED), range(len(log.names)))
    summed = _summed(scaled, leads)
    lost = [0.0] * len(leads)
    quanta = [_quantum(response) for response in log.response.T]
    for j, lead in enumerate(leads):
        scaled, lost[j] = without_lost(scaled, j, lead, repeats=not quanta[j])
    parts = [find_parts(scaled, j, lead) for j, lead in enumerate(leads)]
    fitted = np.empty_like(scaled.response)
    found: list[list[Actuator]] = []
    for j, own in enumerate(parts):
        found.append([_report(log, scaled, part, j, reach, spread) for part in own])
        for part in own:
            rows = slice(part.first, part.last)
            fitted[rows, j] = predict(scaled, j, part)[rows]
    unit, since = _unit([own[-1] for own in found]), log.since
    actuators = []
    for j, numbers in enumerate(found):
        shape = parts[j][-1].model.shape
        endless = {j} if shape.keep > ENDLESS or shape.rate < CREEPS else set()
        how = (log.step, log.usual_delay, _doubt(scaled, j, moved, summed | endless))
        whole = [
            replace(a, unit=unit, lost=lost[j], quantum=quanta[j], turn=turns.get(j, 0.0))
            for a in numbers
        ]
        said = [judge(actuator, *how) for actuator in whole]
        changes = tuple(
            Change(t=float(since[part.first]), before=before, after=after)
            for part, before, after in zip(parts[j][1:], said[:-1], said[1:], strict=True)
            if before.sentence != after.sentence  # otherwise too small to be told
        )
        actuators.append(judge(replace(said[-1], changes=changes), *how))
    return Diagnosis(
        actuators=tuple(actuators),
        step_s=log.step,
        rows=len(log.command),
        notes=log.notes,
        fitted=fitted * spread + read.response - log.response,
    )


def _reach(command: np.ndarray) -> np.ndarray:
    """Return half of the range of each command, ``(A,)``; 1 if it does not change."""
    low, high = np.quantile(command, [0.01, 0.99], axis=0)
    reach = 0.5 * np.where(high > low, high - low, np.ptp(command, axis=0))
    return np.where(reach > 0, reach, 1.0)


def _spread(response: np.ndarray) -> np.ndarray:
    """Return a standard deviation of each response that outliers hardly change, ``(A,)``."""
    low, high = np.quantile(response, [0.02, 0.98], axis=0)
    spread = np.clip(response, low, high).std(0)
    spread = np.where(spread > 0, spread, response.std(0))
    return np.where(spread > 1e-12 * (1e-300 + np.abs(response).max(0)), spread, 1.0)


def _quantum(response: np.ndarray) -> float:
    """Return the size of the steps of a response, 0 if it moves freely."""
    values = np.unique(response)
    steps = np.diff(values)
    if not 3 <= len(values) < FEW * len(response) or not steps.min() > 1e-6 * np.ptp(values):
        return 0.0
    size = float(np.median(steps))
    whole = steps / size
    return size if np.abs(whole - whole.round()).max() < EXACT else 0.0


def _summed(log: Log, leads: Sequence[Lead]) -> set[int]:
    """Return the actuators whose responses do not follow, but change as the commands say."""
    odd = [j for j, lead in enumerate(leads) if lead.left > LOOSE]
    rates = np.diff(log.response, axis=0, prepend=log.response[:1])
    rates[log.begins] = 0.0
    found = find_leads(replace(log, response=rates / _spread(rates)).thinned(SEARCHED), odd)
    close = (rate.left < CLOSE * leads[j].left for j, rate in zip(odd, found, strict=True))
    return {j for j, good in zip(odd, close, strict=True) if good}


def _doubt(log: Log, j: int, moved: np.ndarray, summed: set[int]) -> str:
    """Return why nothing can be told of an actuator, if so."""
    if not moved[j]:
        return "its command does not change"
    if j in summed:
        return "its response moves as if it added up its command; log its rate of change"
    u = log.command - log.command.mean(0)
    power = np.sqrt((u**2).sum(0))
    alike = np.abs(u.T @ u[:, j]) / np.maximum(power * power[j], 1e-300)
    copies = [name for i, name in enumerate(log.names) if i != j and alike[i] > COPY]
    return f"its command is that of {copies[0]}, up to a factor" if copies else ""


def _unit(actuators: Sequence[Actuator]) -> float:
    """Return the gain of healthy actuators: 1, or that of two known units if most have it."""
    gains = np.array([abs(a.gain) for a in actuators])
    clear = [a.gain_interval[0] * a.gain_interval[1] > 0 and abs(a.gain) > 1e-4 for a in actuators]
    if not any(clear):
        return 1.0
    middle = float(np.median(gains[clear]))
    return next((unit for unit in UNITS.values() if abs(middle / unit - 1) < ALIKE), 1.0)


def _report(
    log: Log, scaled: Log, part: Part, j: int, reach: np.ndarray, spread: np.ndarray
) -> Actuator:
    """Return the numbers of a part in the units of the log."""
    part, problem, intervals = settle(scaled, j, part)
    model, shape = part.model, part.model.shape
    unit = reach[model.driver]
    scale = spread[j] / unit
    gain, offset = model.gain * scale, model.offset * spread[j]
    gains, offsets = intervals[0] * scale, intervals[1] * spread[j]
    y = problem.y[problem.use]
    residual = y - model.predict(problem)[problem.use]
    total = float(y.var())
    left = min(float(residual.var()) / total, 1.0) if total > 0 else 0.0
    pattern, share = find_pattern(problem, model) if left > MISFIT else ("", 0.0)
    rows = slice(part.first, part.last)
    low, high = np.quantile(log.command[rows, model.driver], [0.01, 0.99])
    coupling = {
        log.names[i]: float(g * spread[j] / reach[i])
        for i, g in zip(model.others, model.gains, strict=True)
        if i != DOWN
    }
    down = [g for i, g in zip(model.others, model.gains, strict=True) if i == DOWN]
    largest = max(coupling, key=lambda name: abs(coupling[name]), default=None)
    dead_zone = shape.dead_zone or shape.jump
    for end, beyond, sign in ((shape.low, low, 1), (-shape.high, -high, -1)):
        if math.isfinite(end) and 0 < end and -0.1 * end * unit < beyond:
            # One direction only: what is not followed are the small commands.
            shift = sign * gain * end * unit
            dead_zone, offset, offsets = end, offset + shift, offsets + shift
    limits = [end for end in (shape.low, shape.high) if math.isfinite(end)]
    ends = [abs(end) * unit for end in limits if abs(end) != dead_zone]
    drift = {}
    for name, value, change in zip(
        ("gain", "offset"), (gain, offset), np.multiply(part.drift, (scale, spread[j])), strict=True
    ):
        if change:
            drift[name] = (float(value - change / 2), float(value + change / 2))
    return Actuator(
        name=log.names[j],
        gain=float(gain),
        gain_interval=(float(gains[0]), float(gains[1])),
        gain_down=float((model.gain + down[0]) * scale) if down else None,
        reversed=bool(gains[1] < 0 and (not down or model.gain + down[0] < 0)),
        offset=float(offset),
        offset_interval=(float(offsets[0]), float(offsets[1])),
        dead_zone=float(dead_zone * unit),
        saturation=float(np.mean(ends)) if ends else None,
        backlash=float(shape.play * unit),
        stick=float(shape.stick * unit),
        rate=float(shape.rate * unit / log.step) if shape.rate < math.inf else None,
        every=shape.hold,
        delay_s=shape.delay * log.step,
        lag_s=-log.step / math.log(shape.keep) if shape.keep > 1e-6 else 0.0,
        driven_by=log.names[model.driver] if model.driver != j else largest,
        coupling=coupling,
        noise=float(residual.std() * spread[j]),
        unexplained=left,
        pattern=pattern,
        misfit=share * left,
        command_range=(float(low), float(high)),
        drift=drift,
        rows=part.rows,
    )
