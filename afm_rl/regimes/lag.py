"""First-order lag: a slow actuator."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from afm_rl.errors import check_count
from afm_rl.regimes.base import DelayedRegime
from afm_rl.regimes.settings import check_span

SLOWEST = 8.0  # steps


class Lag(DelayedRegime):
    r"""A low-pass filter of first order with a time constant of T steps, the same on all axes.

    .. math:: y_t = a_t + e^{-1 / T} (y_{t-1} - a_t)

    0 is no lag. y begins at the oldest command that is remembered. Without the previous
    commands there is no lag.

    Args:
        span: lowest and highest time constant T (steps) in the prior, uniform.
        history: number of commands that are remembered.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> import torch
    >>> slow, past = Lag(history=3), torch.zeros(3, 1)
    >>> slow.apply(torch.ones(1), slow.encode({"lag": 1.0}), torch.zeros(3), past)
    tensor([0.6321])
    """

    names = ("lag",)
    identity = (0.0,)
    limits = {"lag": (0.0, SLOWEST)}

    def __init__(self, span: Sequence[float] = (0.5, 3.0), history: int = 8) -> None:
        self.span = check_span("span", span, 0.0, SLOWEST)
        self.history = check_count("history", history)

    def effect_of(self, action: Tensor, parameters: Tensor, past: Tensor) -> Tensor:
        """Filter the commands from the oldest one on."""
        keep = (-1 / parameters.abs()).exp()  # 0 where there is no lag
        oldest, *later = reversed(past.unbind(-2))
        effect = oldest
        for command in (*later, action):
            effect = command + keep * (effect - command)
        return effect
