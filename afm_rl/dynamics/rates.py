"""Rates of change with their derivatives: what hybrid models add to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from afm_rl.dynamics.derivatives import derivative
from afm_rl.spaces.manifold import Manifold, wrap_angle


class HeldRate(ABC):
    """The rate of change while an action is held."""

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


class Rate(ABC):
    """Rates of change :math:`x' = f(x, u)`, and what makes a state of what they lead to."""

    @abstractmethod
    def hold(self, action: Tensor) -> HeldRate:
        """Return the rate of change under actions ``(*B, A)``."""

    @abstractmethod
    def finish(self, state: Tensor) -> Tensor:
        """Put integrated states ``(*B, S)`` back into the state space."""

    @abstractmethod
    def finish_tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        """Do so with derivatives ``(*B, S, K)``."""


class FunctionRate(Rate):
    """Any function as a rate; derivatives by forward differentiation.

    Args:
        function: ``function(state, action) -> rate``, batched and differentiable.
        manifold: the state space, whose angles wrap.

    >>> rate = FunctionRate(lambda x, u: torch.cat([x[..., 1:], u], -1), Manifold(2))
    >>> rate.hold(torch.ones(1)).tangent(torch.zeros(2), torch.eye(2, 3))[1]
    tensor([[0., 1., 0.],
            [0., 0., 1.]])
    """

    def __init__(self, function: Callable[[Tensor, Tensor], Tensor], manifold: Manifold) -> None:
        self.function = function
        self.manifold = manifold

    def hold(self, action: Tensor) -> HeldRate:
        return _HeldFunction(self.function, action)

    def finish(self, state: Tensor) -> Tensor:
        return torch.where(self.manifold.is_angle, wrap_angle(state), state)

    def finish_tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        """Wrap the angles, which changes no derivative."""
        return self.finish(state), through


class _HeldFunction(HeldRate):
    def __init__(self, function: Callable[[Tensor, Tensor], Tensor], action: Tensor) -> None:
        self.function, self.action = function, action

    def __call__(self, state: Tensor) -> Tensor:
        return self.function(state, self.action)

    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        size = through.shape[-1]
        wide = [
            given.unsqueeze(-2).expand(*given.shape[:-1], size, -1)
            for given in (state, self.action)
        ]
        actions = self.action.shape[-1]
        drive = torch.eye(size, dtype=state.dtype, device=state.device)[:, size - actions :]
        value, slope = derivative(self.function, wide, (through.mT, drive.expand_as(wide[1])))
        return value[..., 0, :], slope.mT


def on_tangent(space: Manifold, state: Tensor, slope: Tensor, origin: Tensor) -> Tensor:
    """Return the derivative of the difference of a state from an origin, ``(*B, D, K)``.

    Args:
        space: the state space.
        state: ``(*B, S)``.
        slope: its derivative by K parameters in raw coordinates, ``(*B, S, K)``.
        origin: does not move, ``(*B, S)``.

    >>> on_tangent(Manifold(2), torch.ones(2), torch.tensor([[3.0], [4.0]]), torch.zeros(2))
    tensor([[3.],
            [4.]])
    """
    columns = slope.mT
    wide = state.unsqueeze(-2).expand_as(columns)
    differ = partial(space.difference, origin=origin.unsqueeze(-2))
    return derivative(differ, (wide,), (columns,))[1].mT
