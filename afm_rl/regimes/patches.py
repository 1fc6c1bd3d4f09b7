"""Patches of ground on which the actuators work otherwise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import check_counts, check_number
from afm_rl.regimes.base import Regime
from afm_rl.regimes.gain import MOST_GAIN, divide
from afm_rl.regimes.settings import check_span, draw_between


class Patches(Regime):
    r"""A checkerboard of ground; on its odd squares the actions have gains.

    .. math:: a_\mathrm{eff} = g \odot a \quad\text{where}\quad
              \textstyle\sum_i \lfloor s_i / l \rfloor \text{ is odd}

    The prior turns the first axis around, with log-uniform size, and keeps the others.

    Args:
        size: side l of the squares (m).
        where: indices of the state coordinates (m) that say where the robot is.
        names: one parameter name per action axis.
        span: smallest and largest size of the first gain in the prior, > 0.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> ground = Patches(size=2.0)
    >>> row = ground.encode({"patch_v_gain": -1.0})
    >>> ground.apply(torch.ones(2), row, torch.tensor([[1.0, 1.0, 0.0], [3.0, 1.0, 0.0]]))
    tensor([[ 1.,  1.],
            [-1.,  1.]])
    """

    by_state = True

    def __init__(
        self,
        size: float = 2.0,
        where: Sequence[int] = (0, 1),
        names: Sequence[str] = ("patch_v_gain", "patch_omega_gain"),
        span: Sequence[float] = (0.5, 1.5),
    ) -> None:
        self.size = check_number("size", size, low=0.0, open_low=True)
        self.where = check_counts("where", where, low=0)
        self.names = self.distinct(names)
        self.limits = dict.fromkeys(self.names, (-MOST_GAIN, MOST_GAIN))
        self.identity = (1.0,) * len(self.names)
        least = check_number("span", check_span("span", span)[0], low=0.0, open_low=True)
        self.span = math.log(least), math.log(span[1])

    def apply(
        self,
        action: Tensor,
        parameters: Tensor,
        state: Tensor,
        past: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        return action * self._gains(parameters, state)

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        return divide(action, self._gains(parameters, state)).clamp(low, high)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        first = -draw_between(self.span, (*shape, 1), generator).exp()
        return torch.cat([first, torch.ones(*shape, len(self.names) - 1)], -1)

    def _gains(self, parameters: Tensor, state: Tensor) -> Tensor:
        squares = (state[..., self.where] / self.size).floor().sum(-1, keepdim=True)
        return torch.where(squares % 2 == 1, parameters, 1.0)
