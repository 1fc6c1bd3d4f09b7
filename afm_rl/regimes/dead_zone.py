"""Dead zone: small commands do not overcome the friction of the gear."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.regimes.base import Regime
from afm_rl.regimes.settings import HalfRange, check_span, draw_between


class DeadZone(Regime):
    r"""A loss that has to be overcome first, the same on all axes; 0 loses nothing.

    .. math:: u_\mathrm{eff} = \mathrm{sign}(u) \max(|u| - d, 0)

    Args:
        half_range: half ranges of the action axes, the unit of u.
        span: lowest and highest d in the prior, uniform.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> stiff = DeadZone(half_range=[1.0, 2.0])
    >>> stiff.apply(torch.tensor([-0.25, 1.0]), stiff.encode({"dead_zone": 0.25}), torch.zeros(3))
    tensor([-0.0000, 0.5000])
    """

    names = ("dead_zone",)
    identity = (0.0,)
    limits = {"dead_zone": (0.0, 1.0)}

    def __init__(self, half_range: Sequence[float], span: Sequence[float] = (0.1, 0.6)) -> None:
        self.half_range = HalfRange(half_range)
        self.span = check_span("span", span, 0.0, 1.0)

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Take the loss off the size; the state plays no part."""
        loss = parameters * self.half_range.like(action)
        return action.sign() * (action.abs() - loss).clamp(min=0.0)

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        """Add the loss and clamp; the command for no effect is zero."""
        loss = parameters * self.half_range.like(action)
        return (action + action.sign() * loss).clamp(low, high)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw losses ``(*shape, 1)``, uniform."""
        return draw_between(self.span, (*shape, 1), generator)
