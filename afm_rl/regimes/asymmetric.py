"""Actuators that are stronger in one direction than in the other."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import check_number
from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.gain import MOST_GAIN, divide
from afm_rl.regimes.settings import check_span, draw_between


class AsymmetricGain(StaticRegime):
    r"""One gain for commands above zero and another one for those below, on each axis.

    .. math:: a_\mathrm{eff} = \begin{cases} g^+ a & a > 0 \\ g^- a & \text{otherwise}\end{cases}

    Gains are not negative: combine it with :class:`~afm_rl.regimes.ActionGain` to reverse an
    axis. The prior draws both gains of an axis log-uniformly.

    Args:
        names: one name per action axis; its parameters are ``NAME_up`` and ``NAME_down``.
        span: lowest and highest gain in the prior, > 0.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> worn = AsymmetricGain(["v"])
    >>> row = worn.encode({"v_down": 0.5})
    >>> worn.apply(torch.tensor([[1.0], [-1.0]]), row, torch.zeros(3))
    tensor([[ 1.0000],
            [-0.5000]])
    """

    def __init__(self, names: Sequence[str], span: Sequence[float] = (0.3, 1.5)) -> None:
        axes = self.distinct(names)
        self.names = tuple(f"{axis}_{way}" for way in ("up", "down") for axis in axes)
        self.identity = (1.0,) * len(self.names)
        self.limits = dict.fromkeys(self.names, (0.0, MOST_GAIN))
        low, high = check_span("span", span, 0.0, MOST_GAIN)
        check_number("span", low, low=0.0, open_low=True)
        self.span = math.log(low), math.log(high)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        """Multiply by the gain of the command's direction."""
        return action * self._gains(action, parameters)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Divide by the gain of the effect's direction."""
        return divide(effect, self._gains(effect, parameters))

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw gains ``(*shape, 2 A)``: all upward ones, then all downward ones."""
        return draw_between(self.span, (*shape, len(self.names)), generator).exp()

    def _gains(self, action: Tensor, parameters: Tensor) -> Tensor:
        up, down = parameters.chunk(2, -1)
        return torch.where(action > 0, up, down)
