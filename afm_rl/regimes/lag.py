"""First-order lag: a slow actuator."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import check_count
from afm_rl.regimes.base import Regime
from afm_rl.regimes.settings import check_span, draw_between

SLOWEST = 8.0  # steps


class Lag(Regime):
    r"""A low-pass filter of first order with a time constant of T steps, the same on all axes.

    .. math:: y_t = a_t + e^{-1 / T} (y_{t-1} - a_t)

    0 is no lag. y begins at the oldest command that is remembered. Whoever does not know the
    previous commands sees no lag.

    Args:
        span: lowest and highest time constant T (steps) in the prior, uniform.
        history: number of commands that are remembered.

    Raises:
        ConfigurationError: for a setting that cannot be used.

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

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Filter the commands from the oldest one on; the state plays no part."""
        if past is None:
            return action
        keep = (-1 / parameters.abs()).exp()  # 0 where there is no lag
        oldest, *later = reversed(past[..., : self.history, :].unbind(-2))
        effect = oldest
        for command in (*later, action):
            effect = command + keep * (effect - command)
        return effect

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        """Clamp: what was commanded before is not known, and in the long run it plays no part."""
        return action.clamp(low, high)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw time constants ``(*shape, 1)``, uniform."""
        return draw_between(self.span, (*shape, 1), generator)
