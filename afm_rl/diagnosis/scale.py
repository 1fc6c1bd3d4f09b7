"""A log in units in which all actuators are alike, and without angles that jump by a turn."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.response import respond
from afm_rl.diagnosis.search import find_leads
from afm_rl.diagnosis.settings import Settings


@dataclass(frozen=True)
class Scaled:
    """A log in half ranges of commands and standard deviations of responses.

    Args:
        raw: in the units that it was written in.
        log: in units of ``reach`` and ``spread``.
        reach: half range of each command, ``(A,)``; 1 if it does not change.
        spread: standard deviation of each response, ``(A,)``.
    """

    raw: Log
    log: Log
    reach: np.ndarray
    spread: np.ndarray


def scale(log: Log) -> Scaled:
    """Return a log in units in which all actuators are alike."""
    low, high = ends_of(log.command)
    reach = np.where(high > low, 0.5 * (high - low), 1.0)
    spread = reach if log.computed else _spread(log.response)
    alike = replace(log, command=log.command / reach, response=log.response / spread)
    return Scaled(log, alike, reach, spread)


def ends_of(command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest commands, ``(A,)``, but for one row in a hundred at each end.

    All rows count where a command hardly moves otherwise.
    """
    low, high = np.quantile(command, [0.01, 0.99], axis=0)
    rare = high - low < 0.1 * np.ptp(command, axis=0)
    return np.where(rare, command.min(0), low), np.where(rare, command.max(0), high)


def middle_of(ends: tuple[Any, Any]) -> float:
    """Return the middle between two commands, 0 if they come near it."""
    low, high = (float(end) for end in ends)
    near = 0.1 * (high - low)
    return 0.0 if low - near <= 0.0 <= high + near else 0.5 * (low + high)


def _spread(response: np.ndarray) -> np.ndarray:
    """Return a standard deviation of each response that outliers hardly change, ``(A,)``."""
    low, high = np.quantile(response, [0.02, 0.98], axis=0)
    spread = np.clip(response, low, high).std(0)
    spread = np.where(spread > 0, spread, response.std(0))
    return np.where(spread > 1e-12 * (1e-300 + np.abs(response).max(0)), spread, 1.0)


def unwrapped(log: Log, settings: Settings) -> tuple[Log, dict[int, float]]:
    """Return the log without jumps by a turn, and the turns of the actuators that had them.

    A response is unwrapped if the commands explain it far better then; so is a command that wraps
    together with its response, which is no fault and not told.
    """
    turns: dict[int, float] = {}
    for j in range(len(log.names)):
        turn = _turn(log.response[:, j])
        if turn is None:
            continue
        straight = np.unwrap(log.response[:, j], period=turn)
        options = [log.with_column("response", j, straight)]
        if _turn(log.command[:, j]) == turn:
            command = np.unwrap(log.command[:, j], period=turn)
            options.append(options[0].with_column("command", j, command))
        unexplained = [find_leads(each, [j], settings)[0].left for each in (log, *options)]
        best = int(np.argmin(unexplained))
        if best and unexplained[best] < 0.3 * unexplained[0]:
            log = _near_line(options[best - 1], j, turn, settings)
            if best == 1:
                turns[j] = turn
    return log, turns


def _turn(values: np.ndarray) -> float | None:
    """Return by which turn some values jump, if by any."""
    jump, reach = np.abs(np.diff(values)).max(), np.ptp(values)
    turns = (2 * math.pi, 360.0)
    return next((turn for turn in turns if 0.5 * turn < jump and reach < 1.05 * turn), None)


def _near_line(log: Log, j: int, turn: float, settings: Settings) -> Log:
    """Return the log with each response of an actuator in the turn that is next to a line."""
    (lead,) = find_leads(log, [j], settings)
    x = respond(lead.clock_of(log), log.command[:, lead.driver], lead.shape)
    y = log.response[:, j]
    slope = np.cov(x, y)[0, 1] / max(float(x.var()), 1e-300)
    offset = float(np.median(y - slope * x))
    offset -= turn * round(offset / turn)
    line = slope * x + offset
    return log.with_column("response", j, y + turn * np.round((line - y) / turn))
