"""Quantisation: an actuator with few positions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.settings import HalfRange, check_span


class Quantisation(StaticRegime):
    r"""Commands rounded to multiples of a step q, the same on all axes; 0 rounds nothing.

    .. math:: u_\mathrm{eff} = q\,\mathrm{round}(u / q)

    Args:
        half_range: half ranges of the action axes, the unit of u and q.
        span: lowest and highest step q in the prior, uniform.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> coarse = Quantisation(half_range=[1.0, 2.0])
    >>> coarse.apply(torch.tensor([0.3, 0.3]), coarse.encode({"quantum": 0.5}), torch.zeros(3))
    tensor([0.5000, 0.0000])
    """

    names = ("quantum",)
    identity = (0.0,)
    limits = {"quantum": (0.0, 1.0)}

    def __init__(self, half_range: Sequence[float], span: Sequence[float] = (0.1, 0.5)) -> None:
        self.half_range = HalfRange(half_range)
        self.span = check_span("span", span, 0.0, 1.0)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        step = parameters * self.half_range.like(action)
        fine = step == 0
        step = torch.where(fine, 1.0, step)
        return torch.where(fine, action, (action / step).round() * step)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Return the nearest position, or the end of the box that is nearest to it."""
        return self.effect_of(effect, parameters)
