"""The response of an actuator to its commands, as a function of a few numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dtbtrs

from afm_rl.diagnosis.log import Clock


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
        shape: the numbers.
        begin: the response before the first command of each row's episode arrives, ``(N,)``; None:
            at rest at the first command.

    >>> clock = Clock(np.arange(4.0), np.zeros(4, dtype=int), np.arange(4))
    >>> respond(clock, np.array([0.0, 1.0, 0.2, 0.2]), Shape(delay=1.0, dead_zone=0.5))
    array([0. , 0. , 0.5, 0. ])
    >>> respond(clock, np.ones(4), Shape(delay=1.0, rate=0.5), np.zeros(4))
    array([0. , 0.5, 1. , 1. ])
    """
    return lagging(clock, shaped(clock, command, shape, begin), shape.keep)


def shaped(
    clock: Clock, command: np.ndarray, shape: Shape, begin: np.ndarray | None = None
) -> np.ndarray:
    """Return the response ``(N,)`` before the lag."""
    if shape.delay or shape.hold > 1:
        command = look_back(clock, command, shape)
    if shape.jump:
        command = np.where(np.abs(command) > shape.jump, command, 0.0)
    if shape.play:
        command = follow_with_play(command, shape.play, clock.start)
    if shape.stick:
        command = follow_with_stiction(command, shape.stick, clock.start)
    low, high = max(shape.low, -shape.cut), min(shape.high, shape.cut)
    if low > -np.inf or high < np.inf:
        command = np.clip(command, low, high)
    if shape.dead_zone:
        command = command - np.clip(command, -shape.dead_zone, shape.dead_zone)
    if begin is not None:
        command = begin_at(clock, command, begin, shape.delay)
    if shape.rate < np.inf:
        command = limit_rate(command, shape.rate, clock.start)
    return command


def begin_at(clock: Clock, values: np.ndarray, begin: np.ndarray, delay: float) -> np.ndarray:
    """Return values ``(N, ...)`` with those before the first command of an episode replaced."""
    since, values = clock.since, values.copy()
    early = np.flatnonzero(since < max(delay, 1e-9))
    waited = np.where(since[early] > 0, (since[early] - delay + 1).clip(0.0), 0.0)
    share = waited.reshape(-1, *(1 for _ in values.shape[1:]))
    values[early] = begin[early] + share * (values[early] - begin[early])
    return values


def look_back(clock: Clock, values: np.ndarray, shape: Shape) -> np.ndarray:
    """Return values ``(N, ...)`` as they were some steps ago; at the start, the first one."""
    place = clock.places(shape.delay, shape.hold, shape.phase)
    row = place.astype(int)
    if clock.even and shape.delay == int(shape.delay):
        return values[row]
    share = place - row
    after = np.minimum(row + 1, len(values) - 1)
    if values.ndim > 1:
        share = share[:, None]
    return values[row] + share * (values[after] - values[row])


def lagging(clock: Clock, values: np.ndarray, keep: float) -> np.ndarray:
    """Return values ``(N, ...)`` behind a lag of first order, at rest where an episode begins."""
    if not keep:
        return values
    kept_by_row = np.full(len(values), keep)
    if not clock.even:
        kept_by_row[1:] = keep ** np.diff(clock.time)
    kept_by_row[clock.start == np.arange(len(values))] = 0.0
    band = np.ones((2, len(values)))
    band[1, :-1] = -kept_by_row[1:]
    drive = (values.T * (1.0 - kept_by_row)).T
    return dtbtrs(band, drive, uplo="L")[0].reshape(values.shape)


def follow_with_play(command: np.ndarray, width: float, start: np.ndarray) -> np.ndarray:
    """Return the play operator's answer, :math:`y_k = clip(y_{k-1}, u_k - w, u_k + w)`.

    >>> follow_with_play(np.array([0.0, 0.5, 0.3, -0.5]), 0.2, np.zeros(4, dtype=int)).round(6)
    array([ 0. ,  0.3,  0.3, -0.3])
    """
    return _step_by_step(command, start, lambda y, u: min(max(y, u - width), u + width))


def follow_with_stiction(command: np.ndarray, stick: float, start: np.ndarray) -> np.ndarray:
    """Return what stays where it is until the command is farther away than ``stick``.

    >>> one = np.zeros(4, dtype=int)
    >>> follow_with_stiction(np.array([0.0, 0.1, 0.3, 0.2]), 0.2, one)
    array([0. , 0. , 0.3, 0.3])
    """
    return _step_by_step(command, start, lambda y, u: u if abs(u - y) > stick else y)


def limit_rate(target: np.ndarray, rate: float, start: np.ndarray) -> np.ndarray:
    """Return what moves towards targets ``(N,)`` by at most ``rate`` a step.

    >>> limit_rate(np.array([0.0, 1.0, 1.0, 0.0]), 0.5, np.zeros(4, dtype=int))
    array([0. , 0.5, 1. , 0.5])
    """
    if not (np.abs(np.diff(target)[start[1:] == start[:-1]]) > rate).any():
        return target
    return _step_by_step(target, start, lambda y, u: min(max(u, y - rate), y + rate))


def _step_by_step(
    values: np.ndarray, start: np.ndarray, move: Callable[[float, float], float]
) -> np.ndarray:
    """Return ``y_k = move(y_{k-1}, value_k)``, from the first value of each episode on."""
    episodes = np.split(values, np.unique(start)[1:])
    return np.concatenate([list(accumulate(episode.tolist(), move)) for episode in episodes])
