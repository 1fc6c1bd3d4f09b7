"""Backlash: play in a gear, which a command that turns back has to cross first."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import check_count
from afm_rl.regimes.base import DelayedRegime
from afm_rl.regimes.settings import HalfRange, check_span


class Backlash(DelayedRegime):
    r"""The play operator, the same width on all axes: a hysteresis.

    .. math:: y_t = \min(\max(y_{t-1}, u_t - b), u_t + b)

    u are commands in half ranges. y begins at the oldest command that is remembered. Without
    the previous commands there is no backlash.

    Args:
        half_range: half ranges of the action axes.
        span: lowest and highest half width b in the prior, uniform.
        history: number of commands that are remembered.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> loose = Backlash(half_range=[1.0], history=2)
    >>> past = torch.tensor([[0.5], [0.0]])  # newest first: up to 0.5 - 0.2, then back
    >>> loose.apply(torch.tensor([0.2]), loose.encode({"backlash": 0.2}), torch.zeros(3), past)
    tensor([0.3000])
    """

    names = ("backlash",)
    identity = (0.0,)
    limits = {"backlash": (0.0, 1.0)}

    def __init__(
        self,
        half_range: Sequence[float],
        span: Sequence[float] = (0.05, 0.3),
        history: int = 8,
    ) -> None:
        self.half_range = HalfRange(half_range)
        self.span = check_span("span", span, 0.0, 1.0)
        self.history = check_count("history", history)

    def effect_of(self, action: Tensor, parameters: Tensor, past: Tensor) -> Tensor:
        """Follow the commands from the oldest one on."""
        width = parameters * self.half_range.like(action)
        oldest, *later = reversed(past.unbind(-2))
        effect = oldest
        for command in (*later, action):
            effect = torch.minimum(torch.maximum(effect, command - width), command + width)
        return effect
