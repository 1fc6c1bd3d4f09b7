"""Dead zone: small commands do not overcome the friction of the gear."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.settings import HalfRange, check_span


class DeadZone(StaticRegime):
    r"""A loss that has to be overcome first, the same on all axes; 0 loses nothing.

    .. math:: u_\mathrm{eff} = \mathrm{sign}(u) \max(|u| - d, 0)

    Args:
        half_range: half ranges of the action axes, the unit of u.
        span: lowest and highest d in the prior, uniform.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> import torch
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

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        """Take the loss off the size."""
        loss = parameters * self.half_range.like(action)
        return action.sign() * (action.abs() - loss).clamp(min=0.0)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Add the loss; the command for no effect is zero."""
        loss = parameters * self.half_range.like(effect)
        return effect + effect.sign() * loss
