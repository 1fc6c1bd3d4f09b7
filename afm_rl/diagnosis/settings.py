"""What a diagnosis takes for granted, in one place, each number with its reason."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The thresholds of a diagnosis.

    >>> Settings(matters=0.1).matters  # a robot of which 10 % of the gain are no matter
    0.1
    """

    longest_s: float = 1.2
    """Delays are searched up to here (s), and at least ``longest`` rows: networks, hydraulics."""
    quickest: float = 125.0
    """Rows per second that are looked at, at most, where leaving rows out loses nothing: a delay of
    a second is 150 of them."""
    longest: int = 40
    searched: int = 4000
    """Rows of the first search, at most: it takes time in proportion to them."""
    fitted: int = 3000
    """Rows by which a model is chosen, at most: more of them hardly make a difference."""
    refined: int = 12000
    """Rows by which its numbers are found, at most."""
    enough: float = 300.0
    """Independent rows that are enough to choose a model by: more are not looked at."""
    penalty: float = 3.0
    """Twice the log-likelihood that a number has to win beyond BIC's, the logarithm of the rows:
    each number is the best of several that were tried."""
    consistent: float = 1.8
    """Standard errors by which a number has to improve the fit in blocks of the log: 95 %, one
    side, of 12 blocks. What helps in one place only is chance, or another actuator."""
    blocks: int = 12
    """Blocks of the log that are compared with each other."""
    visible: float = 0.02
    """Standard deviations of the response: a number that changes it by less is left out."""
    most: int = 6
    """Numbers beside delay, lag and rate limit, at most."""
    shortest: int = 20
    """Rows of a part of the log in which an actuator stayed as it was."""
    parts: int = 5
    """Such parts, at most: what changes more often is not explained."""
    lags: tuple[float, ...] = (0.0, 1.0, 2.5, 6.0, 15.0, 40.0)
    """Lags at which the search begins (steps)."""
    rates: tuple[float, ...] = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015)
    """Rate limits at which it begins (half ranges per step): 2 to 133 steps from end to end."""
    earliest: int = 5
    """Steps by which a response may come before its command in the log, where rows are shifted."""
    sure: float = 1.45
    """Times the 95 % interval: what a fault has to exceed. That is 99.5 %: ten actuators have a
    hundred numbers."""
    matters: float = 0.05
    """Share of the gain, or of half the range of commands: smaller deviations are no fault."""
    late: float = 0.5
    """Steps: smaller delays and lags are no fault. A logger may be half a row late itself."""
    vague: float = 0.25
    """Share of the healthy gain: where the interval is wider to either side, nothing is said."""
    dead: float = 0.1
    """Share of the healthy gain: an actuator whose whole interval is below does not answer."""
    followed: float = 0.8
    """Share of the range of commands that a healthy joint follows: there are end stops beyond. That
    it stops is said all the same."""
    left: float = 0.05
    """Share of the variance: what leaves more than that unexplained says so."""
    unknown: float = 0.3
    """Share of the variance: what leaves more than that, and no noise, is not explained."""
    moves: float = 0.05
    """Share of the usual range of commands: an actuator that moves less is idle."""
    travel: float = 4.0
    """Ranges of its command that an actuator has to move: up and down twice. Take-off and landing
    alone do not tell a delay from chance; half of it is enough on either side of a change. 0 for
    responses that were computed: nothing else moves those."""
    shared: float | None = 0.25
    """Share of a delay by which those of several actuators may differ, to be the loop's. None where
    the healthy loop is known to have none."""

    def longest_in(self, step: float) -> int:
        """Return the longest delay of the search (steps of so many seconds each).

        >>> Settings().longest_in(0.01), Settings().longest_in(0.1)
        (120, 40)
        """
        return int(max(self.longest_s / step, self.longest))

    def price(self, rows: float) -> float:
        """Return twice the log-likelihood that a parameter must gain in independent rows.

        >>> round(Settings().price(1000), 1)
        9.9
        """
        return self.penalty + math.log(max(rows, 1.0))
