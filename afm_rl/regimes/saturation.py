"""Saturation: a weak battery or a worn motor cuts large commands."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.settings import HalfRange, check_span


class Saturation(StaticRegime):
    r"""Commands cut at a fraction of the half range, the same on all axes; 1 cuts nothing.

    .. math:: u_\mathrm{eff} = \mathrm{clamp}(u, -s, s)

    Args:
        half_range: half ranges of the action axes, the unit of u.
        span: lowest and highest fraction s in the prior, uniform.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> weak = Saturation(half_range=[1.0, 2.0])
    >>> weak.apply(torch.tensor([-0.9, 0.6]), weak.encode({"saturation": 0.5}), torch.zeros(3))
    tensor([-0.5000,  0.6000])
    """

    names = ("saturation",)
    identity = (1.0,)
    limits = {"saturation": (0.01, 1.0)}  # 0 would leave nothing to command

    def __init__(self, half_range: Sequence[float], span: Sequence[float] = (0.2, 0.6)) -> None:
        self.half_range = HalfRange(half_range)
        self.span = check_span("span", span, *self.limits["saturation"])

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        most = torch.where(parameters < 1.0, parameters, torch.inf) * self.half_range.like(action)
        return action.clamp(-most, most)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Return the smallest command with the nearest effect: the effect, cut alike."""
        return self.effect_of(effect, parameters)
