"""Cross-coupling: each actuator also does some of the other's work."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError
from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.settings import HalfRange, check_span


class Rotation(StaticRegime):
    r"""The action, in half ranges, turned by an angle: :math:`u_\mathrm{eff} = R(\phi)\,u`.

    Args:
        half_range: half ranges of the two action axes.
        span: lowest and highest angle (rad) in the prior, uniform.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> coupling = Rotation(half_range=[1.0, 2.0])
    >>> row = coupling.encode({"rotation": math.pi / 2})
    >>> coupling.apply(torch.tensor([0.5, 0.0]), row, torch.zeros(3)).round(decimals=4)
    tensor([-0., 1.])
    """

    names = ("rotation",)
    identity = (0.0,)
    limits = {"rotation": (-2 * math.pi, 2 * math.pi)}

    def __init__(
        self, half_range: Sequence[float], span: Sequence[float] = (-math.pi, math.pi)
    ) -> None:
        self.half_range = HalfRange(half_range)
        if len(self.half_range.values) != 2:
            raise ConfigurationError(f"half_range={half_range!r}: expected two action axes")
        self.span = check_span("span", span)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return self._turned(action, parameters)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Rotate back; not the nearest effect where that does not fit the box."""
        return self._turned(effect, -parameters)

    def _turned(self, action: Tensor, angle: Tensor) -> Tensor:
        # The half ranges stand in the matrix: at angle 0 the action is kept to the bit.
        first, second = self.half_range.values
        cos, sin = angle.squeeze(-1).cos(), angle.squeeze(-1).sin()
        x, y = action.unbind(-1)
        across = x * cos - y * sin * (first / second)
        return torch.stack([across, x * sin * (second / first) + y * cos], -1)
