"""The hypotheses of the belief, in one table: what may the actuators do with commands?

Each row of :data:`HYPOTHESES` is one model of the belief: its name, the function that fits it, or
that says what it expects, and what is wrong in plain words. A new model is such a function and a
row; nothing knows its place in the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from afm_rl.correction.context_windows import CONTEXT_WINDOWS
from afm_rl.correction.healthy import rate_limit, sensor_noise, stiction
from afm_rl.correction.linear import affine, gain, line, opposite, swapped, trend
from afm_rl.errors import ConfigurationError, check_choice

LONGEST_DELAY = 25  # steps of a delay that may be looked for
USUAL_DELAY = 8  # that are, if nothing else is said
FILTER = 12  # commands that a lag looks back on
KINDS = ("as_sent", "network", "line", "map", "late_gain")


class Hypothesis(NamedTuple):
    """One model of what commands do."""

    name: str
    kind: str
    """How it is computed (:mod:`~afm_rl.correction.groups`). "as_sent": commands act as they are
    sent, some day; "network": the network, given a window of the pairs
    (:mod:`~afm_rl.correction.context_windows`); "line" and "map": a fit
    (:mod:`~afm_rl.correction.linear`); "late_gain": a gain of commands that act late."""
    fit: Callable[..., Any] | None = None
    """Of a line or a map, as a function of the evidence."""
    effect: Callable[..., Tensor] | None = None
    """What is expected of a command that acts as it is sent
    (:mod:`~afm_rl.correction.healthy`); None: itself."""
    delay: int = 0
    """Steps from a command to its effect."""
    lag: float = 0.0
    """Time constant with which effects follow commands, in steps."""
    follows_delay: bool = True
    """Does it take any delay that is believed, or always its own?"""
    healthy: bool = False
    """Is there nothing to correct, or nothing that can be corrected?"""
    any_delay: bool = False
    """Does another one of the delays act at every step? Nobody can tell which command will."""
    log_prior: float | None = 0.0
    """Prior log-odds against the network's answer; None: those of a fit, ``plain``."""
    cause: str = "a recent change"
    """In plain words."""

    @property
    def is_late(self) -> bool:
        """Do commands act as they are sent, but late?"""
        return self.kind == "as_sent" and bool(self.delay or self.lag)


def delayed(steps: int) -> str:
    """Return in words that commands are late.

    >>> delayed(1), delayed(2)
    ('1 step late', '2 steps late')
    """
    return f"{steps} step{'s' * (steps > 1)} late"


def _late(kind: str, prefix: str = "") -> list[Hypothesis]:
    """Return the rows of a kind for delays of one to 25 steps, and for lags."""
    delays = [
        Hypothesis(f"{prefix}delay_{k}", kind, delay=k, follows_delay=False, cause=delayed(k))
        for k in range(1, LONGEST_DELAY + 1)
    ]
    return delays + [
        Hypothesis(f"{prefix}lag_{k}", kind, lag=k, follows_delay=False, cause="slow")
        for k in range(1, 4)
    ]


UNCHANGED = "nothing has changed"
NOMINAL = Hypothesis(UNCHANGED, "as_sent", follows_delay=False, healthy=True, cause=UNCHANGED)
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
    *_late("as_sent"),
    Hypothesis("rate limit", "as_sent", effect=rate_limit, healthy=True, cause="rate limit"),
    Hypothesis("sensor noise", "as_sent", effect=sensor_noise, healthy=True, cause="sensor noise"),
    Hypothesis(
        "stiction", "as_sent", effect=stiction, healthy=True, log_prior=-3.0, cause="stiction"
    ),
    Hypothesis(
        "changing delay",
        "as_sent",
        follows_delay=False,
        healthy=True,
        any_delay=True,
        cause="a changing delay",
    ),
    Hypothesis("reversed", "line", opposite),
    Hypothesis("gain", "line", gain, log_prior=None),
    Hypothesis("line", "line", line, log_prior=None),
    Hypothesis("trend", "line", trend, cause="a disturbance"),
    # In periodic motion coupling looks like a delay. Maps are of the present command, whatever
    # delay is believed, so that a wrong one can be rejected.
    Hypothesis("affine", "map", affine, follows_delay=False),
    Hypothesis("swapped", "map", swapped, follows_delay=False),
    # The gain of commands that are not late, as there is one for every delay and lag.
    Hypothesis("gain_now", "late_gain", follows_delay=False, log_prior=None),
    *_late("late_gain", "gain_"),
)
"""All of them. The prior of the first is a setting, ``odds``, and late gains share one."""
CHOICES = [row.name for row in HYPOTHESES if row.kind == "network" or row.is_late]
"""What a robot may name: the others are always there, a late gain with its delay."""
USUAL = [name for name in CHOICES if name not in CONTEXT_WINDOWS or CONTEXT_WINDOWS[name].usual]
"""What is taken if nothing is named, with delays up to the longest that is looked for."""


def choose(
    names: Sequence[str] | None, by_place: bool, plain: float, longest: int = USUAL_DELAY
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses of a robot, each with its prior log-odds.

    Args:
        names: of :data:`CHOICES`; None: the :data:`USUAL` ones, with delays up to the longest.
        by_place: may the ground differ from place to place? Windows by place are dropped else.
        plain: prior log-odds of a fit against an answer of the network.
        longest: delay that is looked for, in steps.

    Raises:
        ConfigurationError: if it is no list of such names, or none by time is left.

    >>> rows = choose(["near", "recent", "lag_1"], by_place=False, plain=-6.0)
    >>> [row.name for row in rows if row.kind not in ("line", "map") and row.effect is None]
    ['nothing has changed', 'recent', 'lag_1', 'changing delay', 'gain_now', 'gain_lag_1']
    """
    if names is None:
        names = [row.name for row in HYPOTHESES if row.name in USUAL and row.delay <= longest]
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
        name = row.name.removeprefix("gain_") if row.kind == "late_gain" else row.name
        return name in names or name not in CHOICES

    rows = [row for row in HYPOTHESES if chosen(row)]
    shared = math.log(max(1, sum(row.is_late for row in rows)))
    priors = [
        plain if row.log_prior is None else row.log_prior - shared * (row.kind == "late_gain")
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
