"""The response of an actuator to its commands, as a function of a few numbers."""

from __future__ import annotations

from typing import NamedTuple

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
    """Largest change per step."""
    hold: int = 1
    """Rows between two commands that are taken over."""
    phase: int = 0
    """First of the rows that are taken over."""

    @property
    def linear(self) -> Shape:
        """Return the shape as other commands have it: delay, lag and hold."""
        return Shape(self.delay, self.keep, hold=self.hold, phase=self.phase)


def respond(clock: Clock, command: np.ndarray, shape: Shape) -> np.ndarray:
    r"""Return the response ``(N,)`` to commands ``(N,)`` at gain 1.

    .. math:: x_k = e^{-\Delta_k/\tau} x_{k-1} + (1 - e^{-\Delta_k/\tau})\,
        z(\mathrm{clip}(p(u(t_k - d))))

    with the play p, the cut, and the dead zone :math:`z(u) = \mathrm{sign}(u)\max(|u| - z, 0)`.

    >>> clock = Clock(np.arange(4.0), np.zeros(4, dtype=int), np.arange(4))
    >>> respond(clock, np.array([0.0, 1.0, 0.2, 0.2]), Shape(delay=1.0, dead_zone=0.5))
    array([0. , 0. , 0.5, 0. ])
    """
    return lagging(clock, shaped(clock, command, shape), shape.keep)


def shaped(clock: Clock, command: np.ndarray, shape: Shape) -> np.ndarray:
    """Return the response ``(N,)`` before the lag."""
    if shape.delay or shape.hold > 1:
        command = look_back(clock, command, shape)
    if shape.jump:
        command = np.where(np.abs(command) > shape.jump, command, 0.0)
    if shape.play:
        command = follow_with_play(command, shape.play, clock.start)
    if shape.stick or shape.rate < np.inf:
        command = follow_step_by_step(command, shape.stick, shape.rate, clock.start)
    if shape.low > -np.inf or shape.high < np.inf:
        command = np.clip(command, shape.low, shape.high)
    if shape.dead_zone:
        command = command - np.clip(command, -shape.dead_zone, shape.dead_zone)
    return command


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
    kept = np.full(len(values), keep)
    if not clock.even:
        kept[1:] = keep ** np.diff(clock.time)
    kept[clock.start == np.arange(len(values))] = 0.0
    band = np.ones((2, len(values)))
    band[1, :-1] = -kept[1:]
    drive = (values.T * (1.0 - kept)).T
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


def follow_step_by_step(
    command: np.ndarray, stick: float, rate: float, start: np.ndarray
) -> np.ndarray:
    """Return what stays where it is until the command is farther away than ``stick``.

    Then it moves there, by at most ``rate`` per row.

    >>> one = np.zeros(4, dtype=int)
    >>> follow_step_by_step(np.array([0.0, 0.1, 0.3, 0.2]), 0.2, np.inf, one)
    array([0. , 0. , 0.3, 0.3])
    >>> follow_step_by_step(np.array([0.0, 1.0, 1.0, 0.0]), 0.0, 0.5, one)
    array([0. , 0.5, 1. , 0.5])
    """
    place, places = 0.0, []
    for row, (value, first) in enumerate(zip(command.tolist(), start.tolist(), strict=True)):
        way = value - place
        if first == row or stick < abs(way) <= rate:
            place = value
        elif abs(way) > stick:
            place += rate if way > 0 else -rate
        places.append(place)
    return np.array(places)
