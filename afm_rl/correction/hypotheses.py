"""The hypotheses of the belief, in one table: what may the actuators do with commands?

Each row of :data:`HYPOTHESES` is one model of the belief; the tick reads the table, and a new model
is a row and the function that fits it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from afm_rl.correction.context_windows import CONTEXT_WINDOWS
from afm_rl.correction.linear import AUTOREGRESSIVE, GAIN, LINE, OFFSET, LineFit
from afm_rl.errors import ConfigurationError, check_choice

LONGEST_DELAY = 25  # steps of a delay that may be looked for
USUAL_DELAY = 8  # that are, if nothing else is said
FILTER = 12  # commands that a lag looks back on
KINDS = ("nominal", "network", "linear", "delay", "delayed gain", "healthy")


class Hypothesis(NamedTuple):
    """One model of what commands do."""

    name: str
    kind: str
    """What forecasts. "nominal": the command itself; "network": the network, given some pairs
    (:mod:`~afm_rl.correction.context_windows`); "linear": a fit
    (:class:`~afm_rl.correction.linear.LinearModels`, in this order); "delay": earlier commands, as
    the row says; "delayed gain": the same times a gain that is fitted; "healthy": models by which
    there is nothing to correct (:func:`~afm_rl.correction.linear.within_rate`,
    :func:`~afm_rl.correction.linear.sensor_noise`), or nothing that can be corrected."""
    delay: int = 0
    """Steps from a command to its effect."""
    lag: float = 0.0
    """Time constant with which effects follow commands, in steps."""
    follows_delay: bool = True
    """Does it take any delay that is believed, or always its own?"""
    log_prior: float | None = 0.0
    """Prior log-odds against the network's answer; None: those of a fit, ``plain``."""
    cause: str = "a recent change"
    """In plain words."""
    fit: LineFit | None = None
    """Of a line of one axis."""

    @property
    def mixes_axes(self) -> bool:
        """Can a command move other axes?"""
        return self.kind == "linear" and not self.follows_delay


def delayed(steps: int) -> str:
    """Return in words that commands are late.

    >>> delayed(1), delayed(2)
    ('1 step late', '2 steps late')
    """
    return f"{steps} step{'s' * (steps > 1)} late"


def _slow(kind: str, prefix: str = "") -> list[Hypothesis]:
    """Return the rows of a kind for delays of one to 25 steps, and for three lags."""
    delays = [
        Hypothesis(f"{prefix}delay_{k}", kind, delay=k, follows_delay=False, cause=delayed(k))
        for k in range(1, LONGEST_DELAY + 1)
    ]
    return delays + [
        Hypothesis(f"{prefix}lag_{k}", kind, lag=k, follows_delay=False, cause="slow")
        for k in range(1, 4)
    ]


def _line(name: str, *fit: Any, **of_fit: Any) -> Hypothesis:
    """Return the row of a line that is fitted, which is worth less than the network, ``plain``."""
    return Hypothesis(name, "linear", log_prior=None, fit=LineFit(*fit, **of_fit))


UNCHANGED = "nothing has changed"
NOMINAL = Hypothesis(UNCHANGED, "nominal", follows_delay=False, cause=UNCHANGED)
HYPOTHESES = (
    NOMINAL,
    *(
        Hypothesis(
            name,
            "network",
            cause="another ground" if window.kind == "near" else "a recent change",
        )
        for name, window in CONTEXT_WINDOWS.items()
    ),
    # The opposite of the command: it needs no fit, and says what every action does.
    Hypothesis("reversed", "linear"),
    # An offset at a gain of one; a gain; gain and offset (a line): of the newest rows, or of all.
    _line("offset_1", OFFSET, rows=1),
    _line("offset_3", OFFSET, rows=3),
    _line("gain_3", GAIN, rows=3),
    _line("gain", GAIN),
    _line("line_12", LINE, rows=12),
    _line("line", LINE),
    _line("drift", GAIN, rows=12, newest_offset=True),
    _line("arx", AUTOREGRESSIVE),  # what goes on from row to row
    # A gain of one, and an offset that goes on as it changes: for commands that are one sine, a
    # disturbance, a delay and a gain look the same, and this explanation does no harm.
    Hypothesis("trend", "linear", cause="a disturbance"),
    # In periodic motion coupling looks like a delay. These are of the present command, whatever
    # delay is believed, so that a wrong one can be rejected.
    Hypothesis("affine", "linear", follows_delay=False),
    Hypothesis("driven", "linear", follows_delay=False),  # by the command of another axis
    Hypothesis("swapped", "linear", follows_delay=False),  # two axes: each other's command
    *_slow("delay"),
    # The gain of commands that are not late, as there is one for every delay and lag.
    Hypothesis("gain_now", "delayed gain", follows_delay=False, log_prior=None),
    *_slow("delayed gain", "gain_"),
    Hypothesis("rate limit", "healthy", cause="rate limit"),
    Hypothesis("sensor noise", "healthy", cause="sensor noise"),
    Hypothesis("stiction", "healthy", log_prior=-3.0, cause="stiction"),
    # At every step another one of the delays: nobody can tell which command will act. It is the
    # last row, of which the belief looks up the delay afterwards.
    Hypothesis("changing delay", "healthy", follows_delay=False, cause="a changing delay"),
)
"""All of them, kind by kind in the order of :data:`KINDS`. The prior of the first is a setting,
``odds``, and those with a delayed gain share one."""
CHOICES = [row.name for row in HYPOTHESES if row.kind in ("network", "delay")]
"""What a robot may name: the others are always there, a delayed gain with its delay."""


def choose(
    names: Sequence[str] | None, by_place: bool, plain: float, longest: int = USUAL_DELAY
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of a robot, each with its prior log-odds.

    Args:
        names: of :data:`CHOICES`; all if None, with delays up to the longest.
        by_place: may the ground differ from place to place? Windows by place are dropped else.
        plain: prior log-odds of a fit against an answer of the network.
        longest: delay that is looked for, in steps.

    Raises:
        ConfigurationError: if it is no list of such names, or none by time is left.

    >>> rows = choose(["near", "recent", "lag_1"], by_place=False, plain=-6.0)
    >>> [row.name for row in rows if row.kind not in ("linear", "healthy")]
    ['nothing has changed', 'recent', 'lag_1', 'gain_now', 'gain_lag_1']
    """
    if names is None:
        names = [row.name for row in HYPOTHESES if row.name in CHOICES and row.delay <= longest]
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise ConfigurationError(
            f"corrector.hypotheses={names!r}: expected a list of {', '.join(CHOICES)}"
        )
    for name in names:
        check_choice("corrector.hypotheses", name, CHOICES)
    if not any(name in CONTEXT_WINDOWS and CONTEXT_WINDOWS[name].kind != "near" for name in names):
        raise ConfigurationError(
            f"corrector.hypotheses={list(names)!r}: expected one by time, such as recent"
        )

    def chosen(row: Hypothesis) -> bool:
        if row.kind == "network" and CONTEXT_WINDOWS[row.name].kind == "near" and not by_place:
            return False
        name = row.name.removeprefix("gain_") if row.kind == "delayed gain" else row.name
        return name in names or name not in CHOICES

    rows = [row for row in HYPOTHESES if chosen(row)]
    shared = math.log(max(1, sum(row.kind == "delay" for row in rows)))
    priors = [
        plain if row.log_prior is None else row.log_prior - shared * (row.kind == "delayed gain")
        for row in rows
    ]
    return tuple(row._replace(log_prior=prior) for row, prior in zip(rows, priors, strict=True))


def acting_of(rows: Sequence[Hypothesis]) -> Tensor:
    """Return what commands weigh in what acts now, by age, the oldest first, ``(W, L)``.

    >>> acting_of([NOMINAL, NOMINAL._replace(delay=2)])
    tensor([[0., 0., 1.],
            [1., 0., 0.]])
    """
    length = 1 + max((row.delay + (FILTER - 1 if row.lag else 0) for row in rows), default=0)
    acting = torch.zeros(len(rows), length)
    for weights, row in zip(acting, rows, strict=True):
        count, keep = (FILTER, math.exp(-1 / row.lag)) if row.lag else (1, 0.0)
        for k in range(count):
            share = 1.0 if k == count - 1 else 1 - keep  # the oldest stands for those before it
            weights[-1 - row.delay - k] = share * keep**k
    return acting
