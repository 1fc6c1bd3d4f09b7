"""What a diagnosis says: one :class:`Actuator` each, and the :class:`Diagnosis` of all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import numpy as np

Status = Literal["healthy", "changed", "dead", "cannot tell", "not measured", "not actuated"]
STATUSES: tuple[str, ...] = get_args(Status)
Interval = tuple[float, float]


def interval(low: Any, high: Any) -> Interval:
    """Return two ends as plain numbers."""
    return float(low), float(high)


def shifted(ends: Interval, by: float) -> Interval:
    """Return an interval that was moved.

    >>> shifted((0.0, 1.0), 0.5)
    (0.5, 1.5)
    """
    return ends[0] + by, ends[1] + by


@dataclass(frozen=True, kw_only=True)
class Actuator:
    r"""How the response of one actuator follows its command.

    .. math:: y(t) = g\, L_\tau[c_s(z(u(t - d)))] + b + \mathrm{noise}

    with the dead zone z, the cut c at s (the saturation), and a lag L of first order.
    """

    name: str
    status: Status = "cannot tell"
    gain: float = math.nan
    """g, response per command; that of ``driven_by`` if its own command has no influence."""
    gain_interval: Interval = (-math.inf, math.inf)
    """95 % interval."""
    gain_down: float | None = None
    """Response per negative command, if ``gain`` is that of positive commands only."""
    reversed: bool = False
    offset: float = math.nan
    """b at the command ``centre``: what is left there of a healthy response,
    ``zero + unit * centre``, in units of the response."""
    offset_interval: Interval = (-math.inf, math.inf)
    offsets: Mapping[str, float] = field(default_factory=dict)
    """The offset of episodes, by their numbers in the log, if it differs by episode."""
    centre: float = 0.0
    """The command at which the offset is meant: 0, or the middle of the range where commands are
    far from 0, or where a healthy actuator and this one meet there."""
    level: float = math.nan
    """The response to a command in the middle of its range."""
    level_interval: Interval = (-math.inf, math.inf)
    dead_zone: float = 0.0
    """Size of commands without effect, in units of the command; 0: no dead zone."""
    limits: Interval | None = None
    """Commands below and above which nothing more happens, both the same if one was seen only."""
    switches: bool = False
    """Whether it has only two responses, independent of the size of its command."""
    backlash: float = 0.0
    """Half of the backlash, in units of the command; 0: no backlash."""
    stick: float = 0.0
    """Change of the command below which nothing moves (stiction); 0: no stiction."""
    rate: float | None = None
    """Largest change per second, in units of the response; None: no rate limit."""
    every: int = 1
    """Number of rows for which a command is held."""
    delay_s: float = 0.0
    """d (s); below 0 if the response precedes its command in the log."""
    time_interval: Interval = (0.0, math.inf)
    """95 % interval of delay and lag together (s)."""
    made_up: bool = False
    """Whether a correction compensated the fault, so that the response is the planned one."""
    lag_s: float = 0.0
    """Time constant of the lag (s)."""
    driven_by: str | None = None
    """Another actuator whose command has an influence, alone (swapped) or in addition."""
    coupling: Mapping[str, float] = field(default_factory=dict)
    """Response per command of other actuators."""
    quantum: float = 0.0
    """Size of the steps in which the response moves, in its units; 0: no steps."""
    reversed_while: str = ""
    """If its sign depends on another command: that command and the sign, in words."""
    turn: float = 0.0
    """Size of the jumps of an angle that is not unwrapped; 0: no jumps."""
    lost: float = 0.0
    """Share of the rows in which the response does not follow; these are excluded."""
    noise: float = math.nan
    """Standard deviation of the residual, in units of the response."""
    unexplained: float = math.nan
    """Unexplained share of the response's variance, lost rows included."""
    pattern: str = ""
    """Quantity on which this share depends, in words; empty if it looks like noise."""
    misfit: float = 0.0
    """Share of the response's variance that depends on it: an error of the fit."""
    command_range: Interval = (math.nan, math.nan)
    """Lowest and highest command, without the extreme 2 % of the rows."""
    command_bounds: Interval | None = None
    """Lowest and highest action, if known."""
    travel: float = math.inf
    """Ranges through which its own command went; moves below three tenths of it are none."""
    copies: tuple[str, ...] = ()
    """Actuators with the same command up to a factor: which of them is followed is not known."""
    units: tuple[str, str] = ("", "")
    """Units of command and response, as text; empty if unknown."""
    unit: float = 1.0
    """Gain of a healthy actuator: pi / 180 where commands are degrees and responses radians."""
    zero: float = 0.0
    """Response of a healthy actuator to the command 0: 2048 where all count from there."""
    drift: Mapping[str, Interval] = field(default_factory=dict)
    """``gain`` or ``offset`` at begin and end of the log, if it changes gradually."""
    changes: tuple[Change, ...] = ()
    """Changes during the log; the numbers above are those after the last change."""
    rows: int = 0
    """Number of rows of the fit."""
    sentence: str = ""

    @property
    def pieces(self) -> tuple[tuple[float, Actuator], ...]:
        """The findings over time, each with its start (s since the log began)."""
        first = self.changes[0].before if self.changes else self
        return (0.0, first), *((change.t, change.after) for change in self.changes)

    @property
    def signed(self) -> bool:
        """Whether the sign of the gain is known."""
        return self.gain_interval[0] * self.gain_interval[1] > 0

    @property
    def saturation(self) -> float | None:
        """Size of commands beyond which the response does not grow; None: no such limit."""
        return None if self.limits is None else float(np.mean(np.abs(self.limits)))

    @property
    def followed(self) -> Interval:
        """Lowest and highest command that is followed; infinite if there is no limit."""
        low, high = self.limits or (-math.inf, math.inf)
        if low < high:
            return low, high
        return (-math.inf, high) if high > self.middle else (low, math.inf)

    @property
    def reach(self) -> float:
        """Half of the range of commands."""
        low, high = self.command_range
        return 0.5 * (high - low)

    @property
    def middle(self) -> float:
        """The middle of the range of commands."""
        return 0.5 * sum(self.command_range)


@dataclass(frozen=True, kw_only=True)
class Change:
    """A sudden change of an actuator."""

    t: float
    """Time (s since the log began)."""
    before: Actuator
    after: Actuator


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """The findings about all actuators of a robot.

    >>> wrist = Actuator(name="wrist", status="healthy", gain=1.0, sentence="wrist: healthy")
    >>> print(Diagnosis(actuators=(wrist,)))
    wrist: healthy
    """

    actuators: tuple[Actuator, ...]
    step_s: float = 1.0
    """Time between two rows (s), the median."""
    rows: int = 0
    notes: tuple[str, ...] = ()
    """Notes about the log."""
    common: tuple[str, ...] = ()
    """Notes about all actuators together: another unit, a delay."""
    fitted: np.ndarray | None = field(default=None, repr=False, compare=False)
    """Fitted responses, ``(N, A)``, for figures."""

    def __str__(self) -> str:
        notes = [f"Note: {note}" for note in self.common]
        return "\n".join([*notes, *(actuator.sentence for actuator in self.actuators)])

    @property
    def healthy(self) -> bool:
        """Whether all actuators are healthy."""
        return all(actuator.status == "healthy" for actuator in self.actuators)

    def as_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain lists and numbers; None for unknown numbers."""
        parts = {"actuators": [asdict(a) | {"saturation": a.saturation} for a in self.actuators]}
        return plain(parts | {"step_s": self.step_s, "rows": self.rows, "notes": self.notes})


def plain(value: Any) -> Any:
    """Return a value as JSON has it; None for what is not finite."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, Mapping):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
