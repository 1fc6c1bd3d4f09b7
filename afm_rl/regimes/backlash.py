"""Backlash: play in a gear, which a command that turns back has to cross first."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import check_count
from afm_rl.regimes.base import Regime
from afm_rl.regimes.settings import HalfRange, check_span, draw_between


class Backlash(Regime):
    r"""The play operator, the same width on all axes: a hysteresis.

    .. math:: y_t = \min(\max(y_{t-1}, u_t - b), u_t + b)

    u are commands in half ranges. y begins at the oldest command that is remembered. Whoever does
    not know the previous commands sees no backlash.

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

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Follow the commands from the oldest one on; the state plays no part."""
        if past is None:
            return action
        width = parameters * self.half_range.like(action)
        oldest, *later = reversed(past[..., : self.history, :].unbind(-2))
        effect = oldest
        for command in (*later, action):
            effect = torch.minimum(torch.maximum(effect, command - width), command + width)
        return effect

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        """Clamp: where in the play the gear stands is not known."""
        return action.clamp(low, high)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw half widths ``(*shape, 1)``, uniform."""
        return draw_between(self.span, (*shape, 1), generator)
