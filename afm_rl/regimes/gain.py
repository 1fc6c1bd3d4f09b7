"""Actuator gains: wear, a reversed motor, a gear of another ratio."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_number
from afm_rl.regimes.base import StaticRegime

MOST_GAIN = 100.0  # gains beyond are typing errors


class ActionGain(StaticRegime):
    r"""Per-axis gains: :math:`a_\mathrm{eff} = g \odot a` (paper, section V-B).

    The prior draws each gain's size log-uniformly, its sign at random, and leaves an axis
    nominal with probability ``nominal``.

    Args:
        names: one parameter name per action axis.
        low: smallest size of a gain in the prior, > 0.
        high: largest size of a gain in the prior.
        nominal: probability that an axis keeps gain 1.

    >>> gains = ActionGain(["v_gain", "omega_gain"])
    >>> row = gains.encode({"v_gain": -1.7})
    >>> gains.apply(torch.tensor([0.5, 1.0]), row, torch.zeros(3))
    tensor([-0.8500,  1.0000])
    """

    def __init__(
        self,
        names: Sequence[str],
        low: float = 0.05,
        high: float = 3.0,
        nominal: float = 0.25,
    ) -> None:
        self.names = self.distinct(names)
        self.identity = (1.0,) * len(self.names)
        self.limits = dict.fromkeys(self.names, (-MOST_GAIN, MOST_GAIN))
        self.low = check_number("low", low, low=0.0, open_low=True)
        self.high = check_number("high", high, low=0.0, open_low=True)
        if self.low > self.high:
            raise ConfigurationError(f"low={low!r}: expected at most high={high!r}")
        self.nominal = check_number("nominal", nominal, low=0.0, high=1.0)

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        """Multiply.

        Raises:
            ConfigurationError: for another number of actions than of names.
        """
        if action.shape[-1] != len(self.names):
            raise ConfigurationError(
                f"ActionGain({list(self.names)}): the robot has {action.shape[-1]} actions; give "
                "one name for each"
            )
        return action * parameters

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Divide; a gain of zero leaves nothing to choose and gives zero."""
        return divide(effect, parameters)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        size = (*shape, len(self.names))
        uniform = torch.rand((3, *size), generator=generator)
        span = math.log(self.high / self.low)
        gains = self.low * torch.exp(span * uniform[0]) * torch.where(uniform[1] < 0.5, -1.0, 1.0)
        return torch.where(uniform[2] < self.nominal, 1.0, gains)


def divide(action: Tensor, gains: Tensor) -> Tensor:
    """Undo gains; one of zero leaves nothing to choose and gives zero.

    >>> divide(torch.tensor([1.0, 1.0]), torch.tensor([-2.0, 0.0]))
    tensor([-0.5000,  0.0000])
    """
    return torch.where(gains == 0, 0.0, action / gains)
