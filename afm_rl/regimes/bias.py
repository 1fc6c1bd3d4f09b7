"""Actuator offsets: a steering that pulls to one side."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.settings import MOST, HalfRange, check_span


class Bias(StaticRegime):
    r"""Per-axis offsets: :math:`a_\mathrm{eff} = a + b \odot h`.

    Args:
        names: one parameter name per action axis.
        half_range: half ranges h of the action axes, the unit of the offsets b.
        span: lowest and highest offset in the prior, uniform.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> import torch
    >>> bias = Bias(["v_bias", "omega_bias"], half_range=[1.0, 2.0])
    >>> bias.apply(torch.zeros(2), bias.encode({"omega_bias": 0.25}), torch.zeros(3))
    tensor([0.0000, 0.5000])
    """

    def __init__(
        self,
        names: Sequence[str],
        half_range: Sequence[float],
        span: Sequence[float] = (-0.4, 0.4),
    ) -> None:
        self.half_range = HalfRange(half_range)
        self.names = self.distinct(names, len(self.half_range.values))
        self.limits = dict.fromkeys(self.names, (-MOST, MOST))
        self.identity = (0.0,) * len(self.names)
        self.span = check_span("span", span)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return action + parameters * self.half_range.like(action)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        return effect - parameters * self.half_range.like(effect)
