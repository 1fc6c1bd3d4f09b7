"""What a robot logged: commands and responses, row by row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from afm_rl.errors import ConfigurationError

FEWEST = 20  # rows
MOST = 256  # actuators
QUICKEST, SLOWEST = 1e-9, 1e9  # time steps, s


@dataclass(frozen=True)
class Log:
    """Commands and responses of A actuators.

    Args:
        names: names of the actuators.
        command: ``(N, A)``.
        response: ``(N, A)``.
        t: times of the rows (s), ascending within each episode; None: one second per row.
        episode: number of the episode of each row, ``(N,)``; None: one episode.
        usual_delay: delay and lag of the healthy robot (s).
        row: number of each row, ``(N,)``, if rows of a longer log were omitted.
        read_from: number of rows of the file; 0: the same number.
        notes: notes about the log.
        effort: effort of the motors, ``(M,)`` each, such as their PWM.
        computed: whether responses were computed from states instead of measured.
        units: of all commands and responses, as text; empty if they are not known.
        doubts: reasons why some actuators cannot be diagnosed, by name.
        command_bounds: lowest and highest possible command, ``(A,)`` each; None: unknown.

    Raises:
        ConfigurationError: for shapes that do not fit, numbers that are not finite, time that does
            not go on, fewer than 20 rows, or more than 256 actuators.
    """

    names: tuple[str, ...]
    command: np.ndarray
    response: np.ndarray
    t: np.ndarray | None = None
    episode: np.ndarray | None = None
    usual_delay: float = 0.0
    row: np.ndarray | None = None
    read_from: int = 0
    notes: tuple[str, ...] = ()
    effort: Mapping[str, np.ndarray] = field(default_factory=dict)
    computed: bool = False
    units: tuple[str, str] = ("", "")
    command_bounds: tuple[np.ndarray, np.ndarray] | None = None
    doubts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rows, size = len(self), len(self.names)
        if not self.command.shape == self.response.shape == (rows, size):
            raise ConfigurationError(
                f"log: commands {self.command.shape}, responses {self.response.shape}: expected "
                f"{size} columns each, one per actuator"
            )
        if size > MOST:  # each is looked at beside each other
            raise ConfigurationError(
                f"log: {size} actuators: expected at most {MOST}; choose some of them"
            )
        if rows < FEWEST and self.row is None:  # a part may have fewer
            raise ConfigurationError(
                f"log: {rows} rows: expected at least {FEWEST}; log for a longer time"
            )
        if not (np.isfinite(self.command).all() and np.isfinite(self.response).all()):
            raise ConfigurationError("log: commands or responses are not finite; remove such rows")
        steps = np.diff(self.seconds)[~self.begins[1:]]
        if (steps <= 0).any():
            raise ConfigurationError("log: t does not increase: expected ascending times (s)")
        if len(steps) and not QUICKEST < self.step < SLOWEST:
            raise ConfigurationError(
                f"log: t has time steps of {self.step:.3g} s: expected steps between {QUICKEST:g} "
                f"and {SLOWEST:g} s; give times in seconds"
            )

    def __len__(self) -> int:
        return len(self.command)

    @property
    def seconds(self) -> np.ndarray:
        """Times of the rows (s), ``(N,)``."""
        return np.arange(len(self), dtype=float) if self.t is None else self.t

    @property
    def begins(self) -> np.ndarray:
        """Which rows begin an episode, ``(N,)``."""
        first = np.zeros(len(self), dtype=bool)
        first[0] = True
        if self.episode is not None:
            first[1:] = self.episode[1:] != self.episode[:-1]
        return first

    @property
    def place(self) -> np.ndarray:
        """The place of each row's episode among all, ``(N,)``."""
        return np.cumsum(self.begins) - 1

    @property
    def start(self) -> np.ndarray:
        """The first row of each row's episode, ``(N,)``."""
        return np.flatnonzero(self.begins)[self.place]

    @property
    def step(self) -> float:
        """Time between two rows (s), the median."""
        return float(np.median(np.diff(self.seconds)[~self.begins[1:]]))

    @property
    def since(self) -> np.ndarray:
        """Time since the log began (s), episodes one after the other, ``(N,)``."""
        step = np.diff(self.seconds, prepend=self.seconds[0])
        step[self.begins] = self.step
        return np.cumsum(step) - self.step

    def with_column(self, kind: str, j: int, values: np.ndarray) -> Log:
        """Return the log with another ``command`` or ``response`` of one actuator, ``(N,)``."""
        table = getattr(self, kind).copy()
        table[:, j] = values
        return replace(self, **{kind: table})

    def part(self, rows: slice | np.ndarray) -> Log:
        """Return some rows, given by a slice or by ascending numbers.

        Rows that are not successive become separate episodes.
        """
        index = np.arange(len(self))[rows]
        episode = self.place[index]
        apart = np.diff(index, prepend=index[:1] - 1) > 1
        return replace(
            self,
            command=self.command[index],
            response=self.response[index],
            t=self.seconds[index],
            row=index if self.row is None else self.row[index],
            episode=np.cumsum(apart | (np.diff(episode, prepend=episode[:1]) != 0)),
        )

    def thinned(self, rows: int, blocks: int = 5) -> Log:
        """Return a log of at most so many rows: blocks of successive rows, evenly spread."""
        if len(self) <= rows:
            return self
        length = rows // blocks
        first = np.linspace(0, len(self) - length, blocks).astype(int)
        return self.part((first[:, None] + np.arange(length)).reshape(-1))


@dataclass(frozen=True)
class Clock:
    """Where in a log to look for the command of some time ago.

    Args:
        time: of each row, in steps, ``(N,)``.
        start: first row of each row's episode, ``(N,)``.
        row: number of each row in the whole log, ``(N,)``.
        hold: a command holds until the next one; otherwise it moves there in a straight line.
    """

    time: np.ndarray
    start: np.ndarray
    row: np.ndarray
    hold: bool = False

    def places(self, delay: Any, every: Any = 1, phase: Any = 0) -> np.ndarray:
        """Return at which row, with fractions, the time was ``delay`` steps ago, ``(N,)``.

        With ``every`` above 1 that is ``delay`` steps before the last row whose number is
        ``phase`` modulo ``every``. Of M delays at once, ``(N, M)``.
        """
        rows, time, start = np.arange(len(self.time), dtype=float), self.time, self.start
        row = self.row
        if np.ndim(delay):
            rows, time, start, row = (x[:, None] for x in (rows, time, start, row))
        if self.even:
            place = rows - delay
        else:
            place = np.interp(time - delay, self.time, rows.ravel())
            place = np.floor(place + 1e-9) if self.hold else place
        if np.any(every > 1):
            latest = np.maximum(rows - (row - phase) % every, 0.0)
            place = np.where(every > 1, latest - delay, place)
        return np.clip(place, start, len(rows) - 1)

    @cached_property
    def since(self) -> np.ndarray:
        """Return the steps since each row's episode began, ``(N,)``."""
        return self.time - self.time[self.start]

    @cached_property
    def even(self) -> bool:
        """Are all rows one step apart?"""
        return bool(self.time[-1] - self.time[0] == len(self.time) - 1)


def clocks_of(log: Log, even_steps: float = 0.02) -> list[Clock]:
    """Return the clocks that a log may have been written by: one if its rows are evenly spaced.

    Otherwise commands may move between rows or hold, or a delay may be one of rows: time stamps
    can scatter where the robot's own cycle does not. Time stamps that scatter by less than
    ``even_steps`` are even.
    """
    start, rows = log.start, np.arange(len(log))
    steps = np.diff(log.seconds, prepend=log.seconds[0] - log.step) / log.step
    steps[log.begins] = 1.0
    row = rows if log.row is None else log.row
    even = Clock(rows.astype(float), start, row)
    if np.abs(steps - 1.0).max() < even_steps:
        return [even]
    time = np.cumsum(steps)
    return [Clock(time, start, row), Clock(time, start, row, hold=True), even]
