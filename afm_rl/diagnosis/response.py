"""The response of an actuator to its commands, as a function of a few numbers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg.lapack import dtbtrs

from afm_rl.diagnosis.log import Clock


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

    A clip of a clip is a clip: N of them take log2(N) passes over arrays.

    >>> follow_with_play(np.array([0.0, 0.5, 0.3, -0.5]), 0.2, np.zeros(4, dtype=int)).round(6)
    array([ 0. ,  0.3,  0.3, -0.3])
    """
    low, high = command - width, command + width
    first = start == np.arange(len(command))
    low[first] = high[first] = command[first]
    reach = 1
    while reach < len(command):
        before_low, before_high = low[:-reach], high[:-reach]
        low[reach:], high[reach:] = (
            np.clip(before_low, low[reach:], high[reach:]),
            np.clip(before_high, low[reach:], high[reach:]),
        )
        if np.array_equal(low, high):
            break
        reach *= 2
    return low


def follow_with_stiction(command: np.ndarray, stick: float, start: np.ndarray) -> np.ndarray:
    """Return what stays where it is until the command is farther away than ``stick``.

    >>> one = np.zeros(4, dtype=int)
    >>> follow_with_stiction(np.array([0.0, 0.1, 0.3, 0.2]), 0.2, one)
    array([0. , 0. , 0.3, 0.3])
    """
    if _many(start):
        return _side_by_side(command, start, lambda x, u: np.where(np.abs(u - x) > stick, u, x))
    places: list[float] = []
    for values in _episodes(command, start):
        place, low, high = 0.0, np.inf, -np.inf
        for value in values:
            if value < low or value > high:
                place, low, high = value, value - stick, value + stick
            places.append(place)
    return np.array(places)


def limit_rate(target: np.ndarray, rate: Any, start: np.ndarray) -> np.ndarray:
    """Return what moves towards targets ``(N, ...)`` by at most ``rate``, a number or ``(...)``.

    >>> limit_rate(np.array([0.0, 1.0, 1.0, 0.0]), 0.5, np.zeros(4, dtype=int))
    array([0. , 0.5, 1. , 0.5])
    """
    if target.ndim > 1 or _many(start):
        return _side_by_side(
            target, start, lambda x, u: np.minimum(np.maximum(u, x - rate), x + rate)
        )
    same = start[1:] == start[:-1]
    if not (np.abs(np.diff(target)[same]) > rate).any():
        return target
    places: list[float] = []
    for values in _episodes(target, start):
        place = values[0]
        for value in values:
            way = value - place
            if way > rate:
                place += rate
            elif way < -rate:
                place -= rate
            else:
                place = value
            places.append(place)
    return np.array(places)


def _episodes(values: np.ndarray, start: np.ndarray) -> list[list[float]]:
    """Return the values of each episode."""
    return [part.tolist() for part in np.split(values, np.unique(start)[1:])]


def _many(start: np.ndarray, least: int = 12) -> bool:
    """Return whether a step of all episodes at once is faster than rows one after the other."""
    length = np.bincount(start).max()
    return bool(length * least < len(start))


def _side_by_side(values: np.ndarray, start: np.ndarray, move: Any) -> np.ndarray:
    """Return ``x_k = move(x_{k-1}, value_k)``, from the first value of each episode on."""
    places = values.copy()
    begins = np.unique(start)
    lengths = np.diff(np.append(begins, len(start)))
    begins, lengths = begins[order := np.argsort(-lengths)], lengths[order]
    for k in range(1, int(lengths[0])):
        rows = begins[: np.searchsorted(-lengths, -k)] + k
        places[rows] = move(places[rows - 1], values[rows])
    return places
