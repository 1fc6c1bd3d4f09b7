"""Which dynamics, and which command, explain a response best: a first look on a grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from afm_rl.diagnosis.lines import ridge
from afm_rl.diagnosis.log import Clock, Log, clocks_of
from afm_rl.diagnosis.response import Shape, begin_at, keep_of, lagging, limit_rate, look_back
from afm_rl.diagnosis.settings import Settings

TINY = 1e-300


class Lead(NamedTuple):
    """Where the search for one actuator's parameters begins."""

    clock: int
    """Number of the clock."""
    shape: Shape
    """Delay and lag of all commands together."""
    driver: int
    """The command that the response follows."""
    left: float
    """Share of the variance that all commands together leave."""
    line: tuple[float, float] | None = None
    """Gain and offset of the driver alone, if it explains anything."""
    starts: tuple[Shape, ...] = ()
    """Of each kind of dynamics the best on the grid."""

    def clock_of(self, log: Log) -> Clock:
        """Return the clock of a log, of which a part may have fewer."""
        clocks = clocks_of(log)
        return clocks[min(self.clock, len(clocks) - 1)]

    def begin_of(self, log: Log, response: np.ndarray) -> np.ndarray | None:
        """Return where each row's episode begins, as its first response shows, ``(N,)``.

        That is in units of the command; None where the command explains nothing.
        """
        if self.line is None:
            return None
        u, (gain, offset) = log.command[:, self.driver], self.line
        return np.clip((response[log.start] - offset) / gain, u.min(), u.max())


def find_leads(log: Log, actuators: Sequence[int], settings: Settings) -> list[Lead]:
    """Return where to begin with each of some actuators, by ``searched`` rows at most."""
    log = log.thinned(settings.searched)
    delays = _delays(log, settings)
    scans = [
        _scan(log, clock, log.response[:, actuators], delays, settings) for clock in clocks_of(log)
    ]
    leads = []
    for place, j in enumerate(actuators):
        options = [_choose(scan, place, j, k) for k, scan in enumerate(scans)]
        leads.append(min(options, key=lambda lead: lead.left))
    return [
        _with_starts(log, j, lead, delays, settings)
        for j, lead in zip(actuators, leads, strict=True)
    ]


def rows_enough(log: Log, settings: Settings) -> np.ndarray:
    """Return the numbers of the rows to look at: all, or every k-th of a quick logger.

    Where commands are other ones in every row, none can be left out: then lines behind delays and
    lags explain less. Nor where commands step: the row of a step, from which a delay follows, would
    not be known.
    """
    rows = np.arange(len(log))
    every = round(1 / log.step / settings.quickest) if log.step != 1.0 else 1
    if every < 2 or len(rows) < 100 * every:
        return rows
    sparse = rows[(rows - log.start) % every == 0]
    moved = np.flatnonzero(np.ptp(log.command, axis=0) > 0).tolist()
    if not moved or any(steps(log.command[:, k]) for k in moved):
        return rows
    unexplained = [
        np.median([lead.left for lead in find_leads(part, moved, settings)])
        for part in (log, only(log, sparse))
    ]
    return sparse if unexplained[1] < 1.1 * unexplained[0] + 1e-3 else rows


def steps(command: np.ndarray, least: float = 0.01) -> bool:
    """Tell whether most changes of a command ``(N,)`` follow a row in which it was held.

    Those below a share of its range do not count.

    >>> smooth = np.sin(np.arange(400) / 20)
    >>> steps(smooth), steps(np.repeat(smooth[::4], 4))
    (False, True)
    """
    change = np.diff(command)
    large = np.abs(change[1:]) > least * np.ptp(command)
    return bool(large.any()) and float((change[:-1][large] == 0).mean()) > 0.5


def only(log: Log, rows: np.ndarray) -> Log:
    """Return a log of some rows, which still follow each other."""
    return replace(log.part(rows), episode=log.place[rows], row=None)


def _delays(log: Log, settings: Settings) -> np.ndarray:
    """Return delays to try (steps): each of the first 20, then 8 % more each time."""
    episode = len(log) / log.begins.sum()
    longest = min(settings.longest_in(log.step), len(log) / 10, episode / 4)
    many = 20 * 1.08 ** np.arange(100)
    delays = np.unique(np.r_[-settings.earliest : 20, many.round()]).astype(int)
    return delays[delays <= max(longest, 1)]


def _scan(
    log: Log, clock: Clock, response: np.ndarray, delays: np.ndarray, settings: Settings
) -> tuple[np.ndarray, ...]:
    """Fit lines with every delay and lag to responses ``(N, R)``.

    Returns:
        the grid of (delay, keep), ``(G, 2)``; the share of variance that each single command
        leaves, ``(G, R, A)``; that all together leave, ``(G, R)``; the lines of single commands,
        ``(G, 2, R, A)``.
    """
    u, y = log.command, without_outliers(response)
    centre, spread = u.mean(0), np.maximum(u.std(0), 1e-12)
    u = (u - centre) / spread
    inside = np.arange(len(u)) - clock.start >= delays.max()
    middle = y[inside].mean(0)
    y = y[inside] - middle
    power = np.maximum((y**2).sum(0), TINY)
    grid, singles, joint, lines = [], [], [], []
    for lag in (lag for lag in settings.lags if lag * 10 < len(u)):
        keep = keep_of(lag)
        slow = lagging(clock, u, keep)
        for delay in delays[delays >= 0] if keep else delays:
            x = look_back(clock, slow, Shape(float(delay)))[inside]
            level = x.mean(0)
            x = x - level
            gram, cross = x.T @ x, x.T @ y
            own = np.maximum(gram.diagonal(), TINY)
            singles.append(1 - (cross**2 / own[:, None] / power).T)
            joint.append(1 - (ridge(gram, cross, 1e-9) * cross).sum(0) / power)
            slope = (cross / own[:, None]).T / spread
            lines.append((slope, middle[:, None] - slope * (centre + level * spread)))
            grid.append((delay, keep))
    return np.array(grid), np.array(singles), np.array(joint), np.array(lines)


def _choose(scan: tuple[np.ndarray, ...], place: int, j: int, clock: int) -> Lead:
    """Choose for one response: the own command, unless another one leaves less than half."""
    grid, single, joint, lines = scan
    unexplained = np.maximum(single[:, place].min(0), 1e-12)  # by each with its best dynamics
    driver = int(unexplained.argmin()) if unexplained.min() < 0.5 * unexplained[j] else j
    # The dynamics are those of all commands together; the driver may be one of several.
    best, alone = int(joint[:, place].argmin()), int(single[:, place, driver].argmin())
    gain, offset = lines[alone, :, place, driver]
    line = (float(gain), float(offset)) if unexplained[driver] < 0.7 and gain else None
    shape = Shape(*grid[best].tolist())
    return Lead(clock, shape, driver, float(joint[best, place]), line)


def _with_starts(log: Log, j: int, lead: Lead, delays: np.ndarray, settings: Settings) -> Lead:
    """Return the lead with the best of each kind of dynamics: delay, lag, rate limit together."""
    plain = [lead.shape]
    begin = lead.begin_of(log, log.response[:, j])
    if lead.shape.keep:
        plain.append(Shape(lead.shape.delay + 0.5 * lead.shape.lag))
    if begin is None or lead.shape.delay < 0:
        return lead._replace(starts=tuple(plain))
    clock = lead.clock_of(log)
    u = log.command[:, lead.driver]
    y = without_outliers(log.response[:, j])
    half = max(0.5 * float(np.ptp(u)), 1e-12)
    rates = [math.inf, *(half * rate for rate in settings.rates)]
    here = begin_at(clock, u, begin, 0.0)
    moves = np.column_stack([limit_rate(here, rate, clock.start) for rate in rates])
    best_of: dict[tuple[bool, bool], tuple[float, Shape]] = {}
    for lag in (0.0, 1.5, 4.0, 12.0):
        slow = lagging(clock, moves, keep_of(lag))
        for delay in delays[delays >= 0].tolist():
            x = begin_at(clock, look_back(clock, slow, Shape(delay)), begin[:, None], delay)
            x = x - x.mean(0)
            won = ((y - y.mean()) @ x) ** 2 / np.maximum((x**2).sum(0), TINY)
            for rate, gain in zip(rates, won.tolist(), strict=True):
                kind = lag > 0, rate < math.inf
                if kind not in best_of or gain > best_of[kind][0]:
                    best_of[kind] = gain, Shape(float(delay), keep_of(lag), rate=rate)
    return lead._replace(starts=(*plain, *(shape for _, shape in best_of.values())))


def without_outliers(y: np.ndarray, far: float = 4.0) -> np.ndarray:
    """Cut responses ``(N, ...)`` that are farther from the median than 4 times the far quantile."""
    low, middle, high = np.quantile(y, [0.02, 0.5, 0.98], axis=0)
    return np.clip(y, middle + far * (low - middle), middle + far * (high - middle))
