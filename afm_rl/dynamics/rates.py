"""Rates of change with their derivatives: what hybrid models add to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from afm_rl.airframe import QuadrotorBody
from afm_rl.dynamics.quadrotor_equations import _hold, _rate, _slope, unit
from afm_rl.manifold import Manifold, wrap_angle


class HeldRate(ABC):
    """The rate of change while an action is held."""

    @abstractmethod
    def __call__(self, state: Tensor) -> Tensor:
        """Return the rate of change ``(*B, S)``."""

    @abstractmethod
    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rate of change and its derivative by start and action.

        Args:
            state: ``(*B, S)``.
            through: derivative of ``state`` by start and action, ``(*B, S, S + A)``.

        Returns:
            ``(*B, S)`` and ``(*B, S, S + A)``.
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
        """Return the rate of change under ``action``."""
        return _HeldFunction(self.function, action)

    def finish(self, state: Tensor) -> Tensor:
        """Wrap the angles."""
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
            given.unsqueeze(-2).expand(*given.shape[:-1], size, -1).contiguous()
            for given in (state, self.action)
        ]
        actions = self.action.shape[-1]
        drive = torch.eye(size, dtype=state.dtype, device=state.device)[:, size - actions :]
        moved = (through.mT.contiguous(), drive.expand_as(wide[1]).contiguous())
        result = torch.func.jvp(self.function, tuple(wide), moved)
        return result[0][..., 0, :], result[1].mT


class QuadrotorRate(Rate):
    """A quadrotor's rate of change, with derivatives in closed form.

    Args:
        body: the quadrotor.

    >>> rate = QuadrotorRate(QuadrotorBody())
    >>> level = torch.zeros(13).index_fill(0, torch.tensor(9), 1.0)
    >>> rate.hold(torch.zeros(4))(level)[3:6]
    tensor([ 0.0000,  0.0000, -9.8100])
    """

    def __init__(self, body: QuadrotorBody) -> None:
        self.body = body

    def hold(self, action: Tensor) -> HeldRate:
        """Return the rate of change under ``action``."""
        return _HeldFlight(action, self.body)

    def finish(self, state: Tensor) -> Tensor:
        """Scale the quaternions to length 1."""
        return unit(state)

    def finish_tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        r"""Scale the quaternions: :math:`d(q/|q|) = (dq - \hat q (\hat q \cdot dq)) / |q|`."""
        size = state[..., 6:10].square().sum(-1, keepdim=True).sqrt().unsqueeze(-1)
        state = unit(state)
        turned, rows = state[..., 6:10].unsqueeze(-1), through[..., 6:10, :]
        rows = (rows - turned * (turned * rows).sum(-2, keepdim=True)) / size
        return state, torch.cat([through[..., :6, :], rows, through[..., 10:, :]], -2)


class _HeldFlight(HeldRate):
    def __init__(self, action: Tensor, body: QuadrotorBody) -> None:
        self.held, self.body = _hold(action, body), body

    def __call__(self, state: Tensor) -> Tensor:
        return _rate(state, self.held)

    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        return _rate(state, self.held), _slope(state, through, self.held, self.body)
