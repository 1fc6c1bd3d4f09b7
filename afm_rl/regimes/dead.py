"""Actuators that lose their effect."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.regimes.base import StaticRegime
from afm_rl.regimes.gain import divide


class DeadActuator(StaticRegime):
    r"""Loss of effectiveness: :math:`a_\mathrm{eff} = (1 - l) \odot a`; 1 is a dead actuator.

    The prior kills one axis and leaves the others nominal.

    Args:
        names: one parameter name per action axis.

    Raises:
        ConfigurationError: unless the names are distinct.

    >>> dead = DeadActuator(["left_loss", "right_loss"])
    >>> dead.apply(torch.ones(2), dead.encode({"left_loss": 1.0}), torch.zeros(3))
    tensor([0., 1.])
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = self.distinct(names)
        self.identity = (0.0,) * len(self.names)
        self.limits = dict.fromkeys(self.names, (0.0, 1.0))

    def effect_of(self, action: Tensor, parameters: Tensor) -> Tensor:
        return action * (1 - parameters)

    def command_for(self, effect: Tensor, parameters: Tensor) -> Tensor:
        """Divide; a dead actuator is given zero."""
        return divide(effect, 1 - parameters)

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw one dead axis each, ``(*shape, A)``."""
        axis = torch.randint(len(self.names), shape, generator=generator)
        return torch.nn.functional.one_hot(axis, len(self.names)).float()
