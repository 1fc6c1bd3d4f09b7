"""A diagnosis from a log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.changes import Part, find_parts, problem_of
from afm_rl.diagnosis.checks import copies_of, echoes, effort_notes, find_doubts
from afm_rl.diagnosis.findings import Actuator, Change, Diagnosis
from afm_rl.diagnosis.kinds import agree, small_twins
from afm_rl.diagnosis.likely import likely_intervals
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.lost import without_lost
from afm_rl.diagnosis.model import DOWN, GAIN_DRIFT, OFFSET_DRIFT
from afm_rl.diagnosis.pattern import find_pattern
from afm_rl.diagnosis.search import find_leads, only, rows_enough
from afm_rl.diagnosis.settings import Settings
from afm_rl.diagnosis.together import shared_delay, unit_of, with_basis
from afm_rl.diagnosis.words import judge
from afm_rl.diagnosis.wrap import unwrapped

ENDLESS = 0.985  # share of the way that is left after a step: no lag, but a sum


def diagnose(log: Log, settings: Settings | None = None) -> Diagnosis:
    """Say what each actuator of a log does.

    Each response is fitted by the model of :class:`Actuator`: delay, lag and rate limit together on
    a grid, then the numbers that its response needs, by robust nonlinear least squares. The log is
    split where an actuator changed. Intervals take residuals that depend on each other into
    account, and commands that hardly differ. Then the actuators are judged together: a delay that
    all share is that of the loop.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (400, 2))
    >>> y = u * [1.0, -0.5] + 0.01 * np.random.default_rng(1).standard_normal((400, 2))
    >>> print(diagnose(Log(("shoulder", "elbow"), u, y)))
    shoulder: healthy
    elbow: reversed, 50 % of the command
    """
    settings = settings or Settings()
    if log.computed:
        settings = replace(settings, travel=0.0)
    exact, same = echoes(log), copies_of(log.command)
    whole, rows = log, rows_enough(log, settings)
    if len(rows) < len(log.command):
        log = only(log, rows)
        note = f"every {len(whole.command) / len(rows):.0f}th row is looked at: they come quickly"
        log = replace(log, notes=(*log.notes, note))
    read = log
    log, turns = unwrapped(log, settings)
    low, high = _ends(log.command)
    reach = np.where(high > low, 0.5 * (high - low), 1.0)
    spread = _spread(log.response)
    scaled = replace(log, command=log.command / reach, response=log.response / spread)
    count = len(log.names)
    leads = find_leads(scaled.thinned(settings.searched), range(count), settings)
    doubts = find_doubts(scaled, leads, reach, exact, settings)
    fitted = np.repeat(log.response.mean(0)[None], len(log.response), 0) / spread
    clean, parts = scaled, dict[int, Sequence[Part]]()
    lost = dict.fromkeys(range(count), 0.0)
    quanta = [_quantum(response) for response in log.response.T]
    for j, lead in enumerate(leads):
        if j in doubts:
            continue
        parts[j] = find_parts(scaled, j, lead, settings)
        clean, lost[j] = without_lost(clean, j, lead, parts[j], repeats=not quanta[j])
        if lost[j]:
            parts[j] = find_parts(clean, j, lead, settings)
    parts = agree(clean, parts, reach, settings)
    found: list[list[Actuator]] = []
    for j, name in enumerate(log.names):
        common = {
            "name": name,
            "lost": lost[j],
            "quantum": quanta[j],
            "turn": turns.get(j, 0.0),
            "units": log.units,
            "copies": tuple(log.names[i] for i in same[j]),
        }
        numbers = [
            _report(log, scaled, clean, part, j, reach, spread, settings)
            for part in parts.get(j, ())
        ]
        numbers = numbers or [Actuator(name=name, rows=len(log.command))]
        found.append([replace(actuator, **common) for actuator in numbers])
        for part in parts.get(j, ()):
            fitted[part.rows, j] = part.predict(clean, j)[part.rows]
            shape = part.model.shape
            if shape.keep > ENDLESS or shape.rate < 0.003:  # half ranges per step: never arrives
                doubts[j] = (
                    "cannot tell",
                    "its response moves as if it added up its command; log its rate of change",
                )
    found = unit_of(found)
    if all(len(parts) == 1 for parts in found):
        found = [[actuator] for actuator in with_basis([one for (one,) in found], settings)]
    usual, note = shared_delay([own[-1] for own in found], whole, settings)
    jumps = [
        f"{log.names[j]} is an angle that jumps by {turn:.4g}; it was unwrapped"
        for j, turn in turns.items()
    ]
    actuators, small = [], small_twins(log.names, reach)
    for j, numbers in enumerate(found):
        how = {"step": whole.step, "timed": log.step != 1.0, "usual_delay": usual[j]}
        how |= {"doubt": doubts.get(j), "settings": settings}
        said = [judge(actuator, **how) for actuator in numbers]
        firsts = [part.first for part in parts.get(j, ())]
        changes = tuple(
            Change(t=float(log.since[first]), before=before, after=after)
            for first, before, after in zip(firsts[1:], said[:-1], said[1:], strict=True)
            if before.sentence != after.sentence  # otherwise too small to be told
            and "cannot tell" not in (before.status, after.status)
        )
        last = judge(replace(said[-1], changes=changes), **how)
        if j in small and last.status == "changed" and not last.reversed:
            last = judge(last, **how | {"doubt": ("cannot tell", small[j])})
        actuators.append(last)
    return Diagnosis(
        actuators=tuple(actuators),
        step_s=whole.step,
        rows=len(whole.command),
        notes=(*log.notes, *note, *effort_notes(log), *jumps),
        fitted=(fitted * spread + read.response - log.response)[
            np.searchsorted(rows, np.arange(len(whole.command)), side="right") - 1
        ],
    )


def _ends(command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest commands, ``(A,)``, but for one row in a hundred at each end.

    All rows count where a command hardly moves otherwise.
    """
    low, high = np.quantile(command, [0.01, 0.99], axis=0)
    rare = high - low < 0.1 * np.ptp(command, axis=0)
    return np.where(rare, command.min(0), low), np.where(rare, command.max(0), high)


def _middle(command: np.ndarray) -> float:
    """Return the middle of a command, 0 if it comes near 0."""
    low, high = (float(end[0]) for end in _ends(command[:, None]))
    near = 0.1 * (high - low)
    return 0.0 if low - near <= 0.0 <= high + near else 0.5 * (low + high)


def _spread(response: np.ndarray) -> np.ndarray:
    """Return a standard deviation of each response that outliers hardly change, ``(A,)``."""
    low, high = np.quantile(response, [0.02, 0.98], axis=0)
    spread = np.clip(response, low, high).std(0)
    spread = np.where(spread > 0, spread, response.std(0))
    return np.where(spread > 1e-12 * (1e-300 + np.abs(response).max(0)), spread, 1.0)


def _quantum(response: np.ndarray, few: float = 0.1) -> float:
    """Return the size of the steps of a response, 0 if it moves freely.

    Args:
        response: ``(N,)``.
        few: share of the rows: a response with more values moves freely.
    """
    values = np.unique(response)
    steps = np.diff(values)
    if not 3 <= len(values) < few * len(response) or not steps.min() > 1e-6 * np.ptp(values):
        return 0.0
    size = float(np.median(steps))
    whole = steps / size
    return size if np.abs(whole - whole.round()).max() < 0.01 else 0.0


def _report(
    log: Log,
    scaled: Log,
    clean: Log,
    part: Part,
    j: int,
    reach: np.ndarray,
    spread: np.ndarray,
    settings: Settings,
) -> Actuator:
    """Return the numbers of a part in the units of the log.

    Args:
        log: as it was written.
        scaled: in half ranges of commands and standard deviations of responses.
        clean: without lost rows.
        part: what was found.
        j: number of the actuator.
        reach: half range of each command.
        spread: standard deviation of each response.
        settings: what matters.
    """
    model, shape = part.model, part.model.shape
    problem = problem_of(clean.part(part.rows).thinned(settings.refined), j, part.lead, settings)
    unit = reach[model.driver]
    scale = spread[j] / unit
    command = log.command[:, model.driver]
    low, high = (float(end[0]) for end in _ends(command[:, None]))
    centre = _middle(command)
    intervals = likely_intervals(problem, model, part, centre / unit, settings)
    extra = dict(zip(model.others, model.gains, strict=True))
    usual = sum(g * _middle(log.command[:, i]) / reach[i] for i, g in extra.items() if i >= 0)
    gain, offset = model.gain * scale, (model.offset + model.gain * centre / unit) * spread[j]
    gains, offsets = intervals[0] * scale, (intervals[1] + usual) * spread[j]
    offset += usual * spread[j]
    away = np.abs(log.response[part.rows, j] - command[part.rows])
    held = command[part.rows].std() < 0.1 * unit and away.max() < settings.matters * unit
    if held:  # as a healthy one would
        gain, offset, gains, offsets = 1.0, centre, np.ones(2), np.full(2, centre)
    y = problem.y[problem.use]
    residual = y - model.predict(problem)[problem.use]
    rows = np.flatnonzero(problem_of(scaled, j, part, settings).use)
    rows = rows[(rows >= part.first) & (rows < part.last)]
    whole = (scaled.response[:, j] - part.predict(clean, j))[rows]
    total = float(scaled.response[rows, j].var())
    left = min(float(whole.var()) / total, 1.0) if total > 0 else 0.0
    left *= not held
    noticed = residual.var() > 0.005 * total and not held
    pattern, share = find_pattern(problem, model) if noticed else ("", 0.0)
    coupling = {log.names[i]: float(g * spread[j] / reach[i]) for i, g in extra.items() if i >= 0}
    largest = max(coupling, key=lambda name: abs(coupling[name]), default=None)
    dead_zone = shape.dead_zone or shape.jump
    for end, beyond, sign in ((shape.low, low, 1), (-shape.high, -high, -1)):
        if math.isfinite(end) and 0 < end and -0.1 * end * unit < beyond and not centre:
            # One direction only: what is not followed are the small commands.
            shift = sign * gain * end * unit
            dead_zone, offset, offsets = end, offset + shift, offsets + shift
    limits = (shape.low, shape.high, -shape.cut, shape.cut)
    limits = [end for end in limits if math.isfinite(end)]
    ends = [end * unit for end in limits if abs(end) != dead_zone]
    drift = {}
    for name, kind, value, size in (
        ("gain", GAIN_DRIFT, gain, scale),
        ("offset", OFFSET_DRIFT, offset, spread[j]),
    ):
        if kind in extra:
            change = extra[kind] * size
            drift[name] = (float(value - change / 2), float(value + change / 2))
    return Actuator(
        name=log.names[j],
        gain=float(gain),
        gain_interval=(float(gains[0]), float(gains[1])),
        gain_down=float((model.gain + extra[DOWN]) * scale) if DOWN in extra else None,
        reversed=bool(gains[1] < 0 and model.gain + extra.get(DOWN, 0.0) < 0),
        offset=float(offset),
        offset_interval=(float(offsets[0]), float(offsets[1])),
        centre=centre,
        dead_zone=float(dead_zone * unit),
        limits=(float(min(ends)), float(max(ends))) if ends else None,
        backlash=float(shape.play * unit),
        stick=float(shape.stick * unit),
        rate=float(abs(gain) * shape.rate * unit / log.step) if shape.rate < math.inf else None,
        every=shape.hold,
        delay_s=shape.delay * log.step,
        time_interval=(float(intervals[2, 0] * log.step), float(intervals[2, 1] * log.step)),
        lag_s=-log.step / math.log(shape.keep) if shape.keep > 1e-6 else 0.0,
        driven_by=log.names[model.driver] if model.driver != j else largest,
        coupling=coupling,
        noise=float(residual.std() * spread[j]),
        unexplained=left,
        pattern=pattern,
        misfit=share * left,
        command_range=(float(low), float(high)),
        drift=drift,
        rows=len(part),
    )
