"""What changes under the robot: regimes as pure functions of the action."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError

SEARCH_POINTS, SEARCH_ROUNDS, SEARCH_SHRINK = 64, 8, 0.45


class Regime(ABC):
    """A family of regimes: the effective action as a function of action and parameters.

    The same object serves the simulator, the oracle and the counterfactual generator. Its
    parameters are one row of named numbers, so a batch of missions, each under a regime of
    its own, is one tensor ``(*B, F)``.

    Attributes:
        names: names of the F parameters, in order.
        identity: their values under nominal dynamics.
    """

    names: tuple[str, ...]
    identity: tuple[float, ...]

    @abstractmethod
    def apply(self, action: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
        """Return what ``action`` ``(*B, A)`` is worth in ``state`` ``(*B, S)``."""

    @abstractmethod
    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw parameters ``(*shape, F)`` from the family's prior."""

    def inverse(
        self, action: Tensor, parameters: Tensor, state: Tensor, low: Tensor, high: Tensor
    ) -> Tensor:
        r"""Return the action in the box whose effect is nearest to ``action``, ``(*B, A)``.

        :math:`\arg\min_{u \in [l, h]} \|(\mathrm{apply}(u) - a) / (h - l)\|`, by a search that
        narrows around the best of a grid of points; families with a closed form override it.
        """
        grid = torch.quasirandom.SobolEngine(len(low)).draw(SEARCH_POINTS).to(low)
        centre, span = ((low + high) / 2).expand_as(action), high - low
        wide = [part.unsqueeze(-2) for part in (parameters, state)]
        for shrink in range(SEARCH_ROUNDS):
            reach = span * SEARCH_SHRINK**shrink
            points = centre.unsqueeze(-2) + (grid - 0.5) * reach
            points = torch.cat([centre.unsqueeze(-2), points], -2)
            points = torch.minimum(torch.maximum(points, low), high)
            miss = (self.apply(points, *wide) - action.unsqueeze(-2)) / span
            best = miss.square().sum(-1).argmin(-1)[..., None, None]
            centre = points.gather(-2, best.expand(*best.shape[:-1], len(low))).squeeze(-2)
        return centre

    def encode(self, values: Mapping[str, float]) -> Tensor:
        """Return the parameter row ``(F,)`` with ``values`` and the rest nominal.

        Raises:
            ConfigurationError: for an unknown name or a value that is not finite.
        """
        row = list(self.identity)
        for name, value in values.items():
            if name not in self.names:
                raise ConfigurationError(
                    f"regimes: unknown parameter {name!r}; allowed: {', '.join(self.names)}"
                )
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not number or not math.isfinite(value):
                raise ConfigurationError(f"regimes: {name}={value!r}: expected a finite number")
            row[self.names.index(name)] = float(value)
        return torch.tensor(row)

    def is_identity(self, parameters: Tensor) -> Tensor:
        """Return ``(*B)`` booleans: is this the nominal regime?"""
        nominal = torch.tensor(self.identity, device=parameters.device, dtype=parameters.dtype)
        return (parameters == nominal).all(-1)


class Compose(Regime):
    """Several families one after the other: the first acts on the action first.

    >>> from afm_rl.regimes import ActionGain
    >>> both = Compose([ActionGain(["a_gain"]), ActionGain(["b_gain"])])
    >>> both.apply(torch.ones(1), both.encode({"a_gain": 2.0, "b_gain": -3.0}), torch.zeros(1))
    tensor([-6.])
    """

    def __init__(self, regimes: Sequence[Regime]) -> None:
        self.regimes = list(regimes)
        self.names = tuple(name for regime in self.regimes for name in regime.names)
        self.identity = tuple(value for regime in self.regimes for value in regime.identity)
        twice = {name for name in self.names if self.names.count(name) > 1}
        if not self.regimes or twice:
            raise ConfigurationError(
                f"regimes: expected families with distinct parameter names, got {self.names}"
            )
        self._sizes = [len(regime.names) for regime in self.regimes]

    def apply(self, action: Tensor, parameters: Tensor, state: Tensor) -> Tensor:
        """Apply every family in turn."""
        for regime, part in zip(self.regimes, parameters.split(self._sizes, -1), strict=True):
            action = regime.apply(action, part, state)
        return action

    def sample(self, shape: tuple[int, ...], generator: torch.Generator | None = None) -> Tensor:
        """Draw every family independently."""
        return torch.cat([regime.sample(shape, generator) for regime in self.regimes], -1)
