"""Rates of change while an action is held, with their derivatives: what hybrid models add to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from afm_rl.dynamics.derivatives import derivative
from afm_rl.spaces.manifold import Manifold, wrap_angle


class HeldRate(ABC):
    """The rate of change :math:`x' = f(x, u)` while an action u is held."""

    @abstractmethod
    def __call__(self, state: Tensor) -> Tensor:
        """Return the rate of change ``(*B, S)``."""

    @abstractmethod
    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rate of change and its derivative by K parameters, the action the last.

        Args:
            state: ``(*B, S)``.
            through: derivative of ``state`` by them, ``(*B, S, K)``.

        Returns:
            ``(*B, S)`` and ``(*B, S, K)``.
        """

    @abstractmethod
    def finish(self, state: Tensor) -> Tensor:
        """Put integrated states ``(*B, S)`` back into the state space."""


class HeldFunction(HeldRate):
    """Any function as a rate; derivatives by forward differentiation.

    Args:
        action: ``(*B, A)``.
        function: ``function(state, action) -> rate``, batched and differentiable.
        manifold: the state space, whose angles wrap.

    >>> held = HeldFunction(torch.ones(1), lambda x, u: torch.cat([x[..., 1:], u], -1), Manifold(2))
    >>> held.tangent(torch.zeros(2), torch.eye(2, 3))[1]
    tensor([[0., 1., 0.],
            [0., 0., 1.]])
    """

    def __init__(
        self, action: Tensor, function: Callable[[Tensor, Tensor], Tensor], manifold: Manifold
    ) -> None:
        self.action, self.function, self.manifold = action, function, manifold

    def __call__(self, state: Tensor) -> Tensor:
        return self.function(state, self.action)

    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        size, actions = through.shape[-1], self.action.shape[-1]
        wide = [
            given.unsqueeze(-2).expand(*given.shape[:-1], size, -1)
            for given in (state, self.action)
        ]
        drive = torch.eye(size, dtype=state.dtype, device=state.device)[:, size - actions :]
        value, slope = derivative(self.function, wide, (through.mT, drive.expand_as(wide[1])))
        return value[..., 0, :], slope.mT

    def finish(self, state: Tensor) -> Tensor:
        return torch.where(self.manifold.is_angle, wrap_angle(state), state)
