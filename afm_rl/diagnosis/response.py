"""The response of an actuator to its commands, as a function of a few numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dtbtrs

from afm_rl.diagnosis.log import Clock

Move = Callable[[float, float], float]
"""Of the place before and the value that is followed."""


def keep_of(lag: float) -> float:
    r"""Return :math:`e^{-1/\tau}`, the share that a lag (steps) keeps for a step; 0 of none.

    >>> round(keep_of(2.0), 2), keep_of(0.0)
    (0.61, 0.0)
    """
    return math.exp(-1 / lag) if lag > 0 else 0.0


class Shape(NamedTuple):
    """How an actuator answers, apart from gain and offset."""

    delay: float = 0.0
    """In steps."""
    keep: float = 0.0
    """Share of the distance to the command that is left after a step: exp(-step / lag)."""
    dead_zone: float = 0.0
    """Size of commands up to which nothing happens."""
    cut: float = np.inf
    """Size of commands beyond which nothing more happens."""
    low: float = -np.inf
    """Lowest command that is followed."""
    high: float = np.inf
    """Highest command that is followed."""
    play: float = 0.0
    """Half width of the backlash."""
    jump: float = 0.0
    """Size of commands up to which nothing happens; larger ones act in full."""
    stick: float = 0.0
    """Change of the command up to which nothing moves; then the command is reached at once."""
    rate: float = np.inf
    """Largest change of the response per step."""
    hold: int = 1
    """Rows between two commands that are taken over."""
    phase: int = 0
    """First of the rows that are taken over."""

    @property
    def lag(self) -> float:
        """The time constant of the lag (steps)."""
        return -1 / math.log(self.keep) if self.keep > 1e-6 else 0.0

    @property
    def endless(self) -> bool:
        """Is it so slow, in half ranges per step, that it never arrives? Then it is a sum."""
        return self.keep > 0.985 or self.rate < 0.003

    @property
    def linear(self) -> Shape:
        """Return the shape as other commands have it: delay, lag and hold."""
        return Shape(self.delay, self.keep, hold=self.hold, phase=self.phase)


def respond(
    clock: Clock, command: np.ndarray, shape: Shape, begin: np.ndarray | None = None
) -> np.ndarray:
    r"""Return the response ``(N,)`` to commands ``(N,)`` at gain 1.

    .. math:: x_k = e^{-\Delta_k/\tau} x_{k-1} + (1 - e^{-\Delta_k/\tau})\,
        r_k, \qquad r_k = r_{k-1} + \mathrm{clip}(z(\mathrm{clip}(p(u(t_k - d)))) - r_{k-1}, \pm R)

    with the play p, the cut, the dead zone :math:`z(u) = \mathrm{sign}(u)\max(|u| - z, 0)`, and the
    largest change R per step.

    Args:
        clock: of the rows.
        command: of one actuator.
        shape: the numbers; of M shapes at once (:func:`stacked`) the response is ``(N, M)``.
        begin: the response before the first command of each row's episode arrives, ``(N,)``; None:
            at rest at the first command.

    >>> clock = Clock(np.arange(4.0), np.zeros(4, dtype=int), np.arange(4))
    >>> respond(clock, np.array([0.0, 1.0, 0.2, 0.2]), Shape(delay=1.0, dead_zone=0.5))
    array([0. , 0. , 0.5, 0. ])
    >>> respond(clock, np.ones(4), Shape(delay=1.0, rate=0.5), np.zeros(4))
    array([0. , 0.5, 1. , 1. ])
    """
    return lagging(clock, shaped(clock, command, shape, begin), shape.keep)


def stacked(shapes: Sequence[Shape]) -> Any:
    """Return M shapes as one, whose numbers are arrays ``(M,)``."""
    columns: Any = map(np.array, zip(*shapes, strict=True))
    return Shape(*columns)


def shaped(
    clock: Clock, command: np.ndarray, shape: Any, begin: np.ndarray | None = None
) -> np.ndarray:
    """Return the response ``(N,)`` before the lag; of M shapes at once, ``(N, M)``."""
    if np.any(shape.delay) or np.any(shape.hold > 1):
        command = look_back(clock, command, shape)
    elif np.ndim(shape.delay):
        command = np.repeat(command[:, None], len(shape.delay), axis=1)
    if np.any(shape.jump):
        command = np.where(np.abs(command) > shape.jump, command, 0.0)
    command = follow_with_play(command, shape.play, clock.start)
    command = follow_with_stiction(command, shape.stick, clock.start)
    low, high = np.maximum(shape.low, -shape.cut), np.minimum(shape.high, shape.cut)
    if np.any(low > -np.inf) or np.any(high < np.inf):
        command = np.clip(command, low, high)
    if np.any(shape.dead_zone):
        command = command - np.clip(command, -shape.dead_zone, shape.dead_zone)
    if begin is not None:
        command = begin_at(clock, command, begin, shape.delay)
    return limit_rate(command, shape.rate, clock.start)


def begin_at(clock: Clock, values: np.ndarray, begin: np.ndarray, delay: Any) -> np.ndarray:
    """Return values ``(N, ...)`` with those before the first command of an episode replaced."""
    early = np.flatnonzero(clock.since < max(np.max(delay), 1e-9))
    since, begin, own = (_aligned(x[early], values) for x in (clock.since, begin, values))
    share = np.where(since > 0, (since - delay + 1).clip(0.0), 0.0)
    values = values.copy()
    values[early] = np.where(since < np.maximum(delay, 1e-9), begin + share * (own - begin), own)
    return values


def look_back(clock: Clock, values: np.ndarray, shape: Shape) -> np.ndarray:
    """Return values ``(N, ...)`` as they were some steps ago; at the start, the first one.

    Of M shapes at once values are ``(N,)``, and the result ``(N, M)``.
    """
    place = clock.places(shape.delay, shape.hold, shape.phase)
    row = place.astype(int)
    share, before = place - row, values[row]
    if not share.any():
        return before
    after = values[np.minimum(row + 1, len(values) - 1)]
    return before + _aligned(share, before) * (after - before)


def _aligned(values: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return values of rows with as many axes as others of these rows."""
    return values.reshape(values.shape + (1,) * (other.ndim - values.ndim))


def lagging(clock: Clock, values: np.ndarray, keep: Any) -> np.ndarray:
    """Return values ``(N, ...)`` behind a lag of first order, at rest where an episode begins."""
    if not np.any(keep):
        return values
    if np.ndim(keep):
        slow = values.copy()
        for one in np.unique(keep[keep > 0]).tolist():
            slow[:, keep == one] = lagging(clock, values[:, keep == one], one)
        return slow
    kept_by_row = np.full(len(values), keep)
    if not clock.even:
        kept_by_row[1:] = keep ** np.diff(clock.time)
    kept_by_row[clock.start == np.arange(len(values))] = 0.0
    band = np.ones((2, len(values)))
    band[1, :-1] = -kept_by_row[1:]
    drive = (values.T * (1.0 - kept_by_row)).T
    return dtbtrs(band, drive, uplo="L")[0].reshape(values.shape)


def follow_with_play(command: np.ndarray, width: Any, start: np.ndarray) -> np.ndarray:
    """Return the play operator's answer, :math:`y_k = clip(y_{k-1}, u_k - w, u_k + w)`.

    >>> follow_with_play(np.array([0.0, 0.5, 0.3, -0.5]), 0.2, np.zeros(4, dtype=int)).round(6)
    array([ 0. ,  0.3,  0.3, -0.3])
    """
    return _step_by_step(command, start, width, lambda w: lambda y, u: min(max(y, u - w), u + w))


def follow_with_stiction(command: np.ndarray, stick: Any, start: np.ndarray) -> np.ndarray:
    """Return what stays where it is until the command is farther away than ``stick``.

    >>> one = np.zeros(4, dtype=int)
    >>> follow_with_stiction(np.array([0.0, 0.1, 0.3, 0.2]), 0.2, one)
    array([0. , 0. , 0.3, 0.3])
    """
    return _step_by_step(command, start, stick, lambda s: lambda y, u: u if abs(u - y) > s else y)


def limit_rate(target: np.ndarray, rate: Any, start: np.ndarray) -> np.ndarray:
    """Return what moves towards targets ``(N,)`` by at most ``rate`` a step.

    >>> limit_rate(np.array([0.0, 1.0, 1.0, 0.0]), 0.5, np.zeros(4, dtype=int))
    array([0. , 0.5, 1. , 0.5])
    """
    if not np.any(np.isfinite(rate)):
        return target
    moves = np.abs(np.diff(target, axis=0)[start[1:] == start[:-1]])
    if not (moves > rate).any():
        return target
    return _step_by_step(target, start, rate, lambda r: lambda y, u: min(max(u, y - r), y + r))


def _step_by_step(
    values: np.ndarray, start: np.ndarray, number: Any, rule: Callable[[float], Move]
) -> np.ndarray:
    """Return ``y_k = move(y_{k-1}, value_k)``, from the first value of each episode on.

    The move is that of a number, of which 0 and infinity change nothing; of M numbers, ``(N, M)``.
    """
    active = (number > 0) & (number < np.inf)
    if not np.any(active):
        return values
    if np.ndim(number):
        moved = values.copy()
        for k in np.flatnonzero(active):
            moved[:, k] = _step_by_step(values[:, k], start, float(number[k]), rule)
        return moved
    episodes = np.split(values, np.flatnonzero(np.diff(start)) + 1)
    move = rule(number)
    return np.concatenate([list(accumulate(episode.tolist(), move)) for episode in episodes])
