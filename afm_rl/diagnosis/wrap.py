"""Angles that jump by a whole turn."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.response import Shape, respond
from afm_rl.diagnosis.search import find_leads
from afm_rl.diagnosis.settings import Settings

TURNS = (2 * math.pi, 360.0)


def unwrapped(log: Log, settings: Settings) -> tuple[Log, dict[int, float]]:
    """Return the log without jumps by a turn, and the turns of the actuators that had them.

    A response is unwrapped if the commands explain it far better then; so is a command that wraps
    together with its response, which is no fault and not told.

    Args:
        log: as it was written.
        settings: of the search for an explanation.
    """
    turns: dict[int, float] = {}
    for j in range(len(log.names)):
        turn = _turn(log.response[:, j])
        if turn is None:
            continue
        straight = np.unwrap(log.response[:, j], period=turn)
        options = [_with(log, "response", j, straight)]
        if _turn(log.command[:, j]) == turn:
            both = _with(options[0], "command", j, np.unwrap(log.command[:, j], period=turn))
            options.append(both)
        left = [
            find_leads(option.thinned(settings.searched), [j], settings)[0].left
            for option in (log, *options)
        ]
        best = int(np.argmin(left))
        if best and left[best] < 0.3 * left[0]:
            log = _near_line(options[best - 1], j, turn, settings)
            if best == 1:
                turns[j] = turn
    return log, turns


def _turn(values: np.ndarray) -> float | None:
    """Return by which turn some values jump, if by any."""
    jump, reach = np.abs(np.diff(values)).max(), np.ptp(values)
    return next((turn for turn in TURNS if 0.5 * turn < jump and reach < 1.05 * turn), None)


def _with(log: Log, kind: str, j: int, values: np.ndarray) -> Log:
    table = getattr(log, kind).copy()
    table[:, j] = values
    return replace(log, **{kind: table})


def _near_line(log: Log, j: int, turn: float, settings: Settings) -> Log:
    """Return the log with each response of an actuator in the turn that is next to a line."""
    (lead,) = find_leads(log.thinned(settings.searched), [j], settings)
    x = respond(lead.clock_of(log), log.command[:, lead.driver], Shape(lead.delay, lead.keep))
    y = log.response[:, j]
    slope = np.cov(x, y)[0, 1] / max(float(x.var()), 1e-300)
    offset = float(np.median(y - slope * x))
    offset -= turn * round(offset / turn)
    line = slope * x + offset
    return _with(log, "response", j, y + turn * np.round((line - y) / turn))
