"""Which delay and lag, and which command, explain a response best: a first look by lines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from afm_rl.diagnosis.log import Clock, Log, clocks_of
from afm_rl.diagnosis.response import Shape, lagging, look_back

LONGEST = 40  # steps of delay
EARLIEST = 5  # steps by which a response may come before its command in the log
LAGS = (0.0, 1.0, 2.5, 6.0, 15.0)  # steps
OTHERS = 0.5  # share of the squared residual that another command may leave, to be the driver
RIDGE = 1e-9
OUTLIERS = 4.0  # times the distance from the median to the far quantile: where responses are cut


class Lead(NamedTuple):
    """Where the search for one actuator's parameters begins."""

    clock: int
    """Number of the clock."""
    delay: float
    """In steps."""
    keep: float
    """exp(-step / lag)"""
    driver: int
    """The command that the response follows."""
    gains: np.ndarray
    """Of all commands together, ``(A,)``."""
    left: float
    """Share of the variance that the driver leaves."""

    def clock_of(self, log: Log) -> Clock:
        """Return the clock of a log, of which a part may have fewer."""
        clocks = clocks_of(log)
        return clocks[min(self.clock, len(clocks) - 1)]


def find_leads(log: Log, actuators: Sequence[int]) -> list[Lead]:
    """Return where to begin with each of some actuators."""
    found = [_scan(log, clock, log.response[:, actuators]) for clock in clocks_of(log)]
    leads = []
    for place, j in enumerate(actuators):
        options = [_choose(scan, place, j, k) for k, scan in enumerate(found)]
        leads.append(min(options, key=lambda lead: lead.left))
    return leads


def _scan(log: Log, clock: Clock, response: np.ndarray) -> tuple[np.ndarray, ...]:
    """Fit lines with every delay and lag to responses ``(N, R)``.

    Returns:
        the grid of (delay, keep), ``(G, 2)``; the share of variance that each single command
        leaves, ``(G, R, A)``; that all together leave, ``(G, R)``; the gains of these,
        ``(G, R, A)``.
    """
    u = log.command - log.command.mean(0)
    u /= np.maximum(u.std(0), 1e-12)
    y = _without_outliers(response)
    longest = int(min(LONGEST, len(u) // 10))
    inside = np.arange(len(u)) - clock.start >= longest
    if inside.mean() < 0.5:  # many short episodes
        longest = int(min(longest, 8))
        inside = np.arange(len(u)) - clock.start >= longest
    y = y[inside] - y[inside].mean(0)
    power = np.maximum((y**2).sum(0), 1e-300)
    size = u.shape[1]
    grid, singles, joint, slopes = [], [], [], []
    for lag in (lag for lag in LAGS if lag * 10 < len(u)):
        keep = math.exp(-1 / lag) if lag else 0.0
        slow = lagging(clock, u, keep) if keep else u
        for delay in range(0 if keep else -EARLIEST, (longest // 2 if keep else longest) + 1):
            x = look_back(clock, slow, Shape(delay))[inside]
            x = x - x.mean(0)
            gram, cross = x.T @ x, x.T @ y
            own = np.maximum(gram.diagonal(), 1e-300)
            singles.append(1 - (cross**2 / own[:, None] / power).T)
            solution = np.linalg.solve(gram + RIDGE * gram.trace() * np.eye(size) + 1e-300, cross)
            joint.append(1 - (solution * cross).sum(0) / power)
            slopes.append(solution.T)
            grid.append((delay, keep))
    scale = np.maximum(log.command.std(0), 1e-12)
    return np.array(grid), np.array(singles), np.array(joint), np.array(slopes) / scale


def _choose(scan: tuple[np.ndarray, ...], place: int, j: int, clock: int) -> Lead:
    """Choose for one response: the own command, unless another one is much better."""
    grid, single, joint, slopes = scan
    left = np.maximum(single[:, place].min(0), 1e-12)  # of each command with its best dynamics
    driver = int(left.argmin()) if left.min() < OTHERS * left[j] else j
    # The dynamics are those of all commands together; the driver may be one of several.
    best = int(joint[:, place].argmin())
    delay, keep = grid[best]
    gains, rest = slopes[best, place], float(joint[best, place])
    return Lead(clock, float(delay), float(keep), driver, gains, rest)


def _without_outliers(y: np.ndarray) -> np.ndarray:
    """Cut what is far from everything else."""
    low, middle, high = np.quantile(y, [0.02, 0.5, 0.98], axis=0)
    return np.clip(y, middle + OUTLIERS * (low - middle), middle + OUTLIERS * (high - middle))
