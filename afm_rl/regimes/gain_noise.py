"""Gain noise: an actuator whose strength flickers."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from afm_rl.regimes.base import Regime
from afm_rl.regimes.settings import MOST, check_span


class GainNoise(Regime):
    r"""Gains that are drawn anew at each step, the same spread on all axes.

    .. math:: a_\mathrm{eff} = a\,(1 + \sigma \epsilon), \quad \epsilon \sim N(0, I)

    Without noise to draw on, the effect is its mean: the action.

    Args:
        span: lowest and highest standard deviation in the prior, uniform.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> import torch
    >>> shaky, noise = GainNoise(), torch.tensor([1.0, -2.0])
    >>> shaky.apply(torch.ones(2), shaky.encode({"gain_noise": 0.25}), torch.zeros(3), noise=noise)
    tensor([1.2500, 0.5000])
    """

    names = ("gain_noise",)
    identity = (0.0,)
    limits = {"gain_noise": (0.0, MOST)}
    noisy = True

    def __init__(self, span: Sequence[float] = (0.1, 0.5)) -> None:
        self.span = check_span("span", span, 0.0, MOST)

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        return action if noise is None else action * (1 + parameters * noise)

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        """Clamp: the mean effect of an action is the action."""
        return action.clamp(low, high)
