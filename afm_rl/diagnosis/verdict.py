"""A diagnosis from a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from afm_rl.diagnosis.changes import Channel, Parts, changes_of, find_parts
from afm_rl.diagnosis.checks import (
    MIXED,
    SUMMED,
    Doubt,
    alternates,
    copies_of,
    echoes,
    effort_notes,
    find_doubts,
)
from afm_rl.diagnosis.findings import Actuator, Change, Diagnosis, interval
from afm_rl.diagnosis.fit import with_gain
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.numbers import by_episode, numbers_of, quantum_of
from afm_rl.diagnosis.residuals import with_sign_of_other, without_lost, without_steps
from afm_rl.diagnosis.scale import Scaled, scale, unwrapped
from afm_rl.diagnosis.search import find_leads, only, rows_enough
from afm_rl.diagnosis.settings import Settings
from afm_rl.diagnosis.together import agree, in_units, shared_delay, small_twins
from afm_rl.diagnosis.words import judge


def diagnose(log: Log, settings: Settings | None = None) -> Diagnosis:
    """Diagnose each actuator of a log.

    Each response is fitted by the model of :class:`Actuator`: delay, lag and rate limit together on
    a grid, then the other parameters that the response needs, by robust nonlinear least squares.
    The log is split if an actuator changed. Intervals account for correlated residuals and for
    commands that hardly differ. Then the actuators are judged together: a delay that
    all share belongs to the loop.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (400, 2))
    >>> y = u * [1.0, -0.5] + 0.01 * np.random.default_rng(1).standard_normal((400, 2))
    >>> print(diagnose(Log(("shoulder", "elbow"), u, y)))
    shoulder: healthy
    elbow: reversed, 50 % of the command
    """
    settings = settings or Settings()
    if log.computed:  # by the model of a healthy robot, of which a shared delay is no part
        few: Any = {"travel": 0.0, "shortest": 8, "consistent": 0.0, "shared": None}
        settings = replace(settings, **few, penalty=2 * settings.penalty)
    exact, same = echoes(log), copies_of(log.command)
    rows = rows_enough(log, settings)
    read = log if len(rows) == len(log) else only(log, rows)
    straight, turns = (read, {}) if log.computed else unwrapped(read, settings)
    scaled = scale(straight)
    scaled, clean, parts, doubts, shifts, signed = _explain(scaled, exact, settings)
    actuators, times = [], []
    fitted, limits = np.zeros_like(straight.response), log.command_bounds
    for j, name in enumerate(log.names):
        own = parts.get(j, ())
        channel = Channel(clean, j, settings)
        changes = changes_of(own) or [(0, 0)]
        numbers = [numbers_of(scaled, channel, part) for part in own]
        numbers = numbers or [Actuator(name=name, rows=len(log))]
        if j in shifts:
            shift = shifts[j] * scaled.spread[j]
            numbers = [by_episode(piece, shift, settings) for piece in numbers]
            fitted[:, j] = shift[read.place]
        about: dict[str, Any] = {
            "units": log.units,
            "command_bounds": limits and interval(limits[0][j], limits[1][j]),
            "copies": tuple(log.names[i] for i in same[j]),
            "turn": turns.get(j, 0.0),
            "quantum": quantum_of(straight.response[:, j]),
            "lost": float((clean.response[:, j] != scaled.log.response[:, j]).mean()),
        }
        if j in signed:
            side = "negative" if numbers[-1].gain > 0 else "positive"
            about["reversed_while"] = f"the command of {log.names[signed[j]]} is {side}"
        actuators.append([replace(numbers[k], **about) for _, k in changes])
        times.append([float(read.since[row]) for row, _ in changes])
        if not own:
            fitted[:, j] = straight.response[:, j].mean()
        for part in own:
            fitted[part.rows, j] += channel.predict(part)[part.rows] * scaled.spread[j]
    actuators, units = in_units(actuators, settings)
    usual, shared = shared_delay([own[-1] for own in actuators], log, settings)
    small = {} if log.computed else small_twins(log.names, scaled.reach)  # friction is a fault
    mixed = [not log.computed and alternates(u) for u in log.command.T]
    how = {"step": log.step, "usual_delay": usual, "settings": settings}
    judged = (
        _judged(own, times[j], doubts.get(j), small.get(j), mixed[j], how)
        for j, own in enumerate(actuators)
    )
    notes = [f"{log.names[j]}: an angle that jumps by {turns[j]:.4g}; unwrapped" for j in turns]
    if len(rows) < len(log):
        every = round(len(log) / len(rows))
        notes.append(f"one of {every} rows is used: the others add nothing")
    fitted += read.response - straight.response
    return Diagnosis(
        actuators=tuple(judged),
        step_s=log.step,
        rows=len(log),
        common=(*units, *shared),
        notes=(*log.notes, *units, *shared, *effort_notes(log), *notes),
        fitted=fitted[np.searchsorted(rows, np.arange(len(log)), side="right") - 1],
    )


def _explain(
    scaled: Scaled, exact: Sequence[bool], settings: Settings
) -> tuple[Scaled, Log, Parts, dict[int, Doubt], dict[int, np.ndarray], dict[int, int]]:
    """Return what explains each response, or why nothing does.

    That is the log without offsets that differ by episode, the same without lost rows, the parts,
    the doubts, these offsets, and the commands that decide the sign of some actuators.
    """
    log, names = scaled.log, scaled.raw.names
    leads = find_leads(log, range(len(names)), settings)
    shifts: dict[int, np.ndarray] = {}
    signed: dict[int, int] = {}
    for j, lead in enumerate(leads):
        other, by = with_sign_of_other(log, j, lead, settings)
        if by is not None:
            log, signed[j] = other, by
            (lead,) = find_leads(log, [j], settings)
            leads[j] = lead
        log, shift = without_steps(log, j, lead, settings)
        if len(shift):
            shifts[j] = shift
            (leads[j],) = find_leads(log, [j], settings)
    doubts = find_doubts(log, leads, scaled.reach, exact, settings)
    clean, parts = log, Parts()
    for j, lead in enumerate(leads):
        if j not in doubts:
            parts[j] = find_parts(Channel(log, j, settings), lead)
            repeats = not quantum_of(scaled.raw.response[:, j])
            clean, lost = without_lost(Channel(clean, j, settings), lead, parts[j], repeats)
            if lost:
                parts[j] = find_parts(Channel(clean, j, settings), lead)
    parts = agree(clean, parts, scaled.reach, settings)
    for j, own in parts.items():
        if len(own) == 1 and own[0].model.driver == j:
            problem = Channel(clean, j, settings).thinned().problem(own[0].lead)
            usual = float(scaled.reach[j] / scaled.spread[j])
            model = with_gain(problem, own[0].model, usual)
            parts[j] = own = [replace(own[0], model=model)]
        if any(part.model.shape.endless for part in own):
            doubts[j] = SUMMED
    return replace(scaled, log=log), clean, parts, doubts, shifts, signed


def _judged(
    pieces: Sequence[Actuator],
    times: Sequence[float],
    doubt: Doubt | None,
    small: str | None,
    mixed: bool,
    how: Mapping[str, Any],
) -> Actuator:
    """Return the last piece of an actuator with its status, its sentence, and its changes."""
    said = [judge(piece, doubt=doubt, **how) for piece in pieces]
    changes = tuple(
        Change(t=time, before=before, after=after)
        for time, before, after in zip(times[1:], said, said[1:], strict=False)
        if before.sentence != after.sentence  # otherwise too small to be told
    )
    last = judge(replace(said[-1], changes=changes), doubt=doubt, **how)
    odd = abs(abs(last.gain) - last.unit) > how["settings"].vague * last.unit
    if mixed and last.status in ("changed", "dead") and (odd or last.unexplained > 0.1):
        last = judge(last, doubt=MIXED, **how)
    if small and last.status == "changed" and not last.reversed:
        last = judge(last, doubt=("cannot tell", small), **how)
    return last
