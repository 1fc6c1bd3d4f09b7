"""A known rate of change plus a network's."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics.body_frame import to_world, to_world_slope
from afm_rl.dynamics.rates import HeldRate
from afm_rl.dynamics.residual import Network, residual, residual_slope


class HeldHybrid(HeldRate):
    r"""Return :math:`f(x, u) + N([x; u])` and its derivatives, the action held.

    Args:
        nominal: f under ``action``.
        network: N, one per leading index.
        action: u, ``(l, n, A)``; states are ``(l, n, S)``.
        features: indices of the state coordinates that the network sees, None for all.
        turned: whether the network speaks in the frame of a rigid body, see
            :func:`~afm_rl.dynamics.body_frame.to_world`.

    >>> from afm_rl.dynamics.rates import HeldFunction
    >>> from afm_rl.dynamics.residual import draw_network
    >>> from afm_rl.spaces.manifold import Manifold
    >>> action, network = torch.zeros(1, 7, 1), draw_network(torch.ones(1, 10), 3, 2, 2)
    >>> nominal = HeldFunction(action, lambda x, u: -x + u, Manifold(2))
    >>> held = HeldHybrid(nominal, network, action, features=None)
    >>> held.tangent(torch.zeros(1, 7, 2), torch.eye(2, 3).expand(1, 7, 2, 3))[1].shape
    torch.Size([1, 7, 2, 3])
    """

    def __init__(
        self,
        nominal: HeldRate,
        network: Network,
        action: Tensor,
        features: list[int] | None,
        turned: bool = False,
    ) -> None:
        self.nominal, self.network, self.action, self.turned = nominal, network, action, turned
        self.features: slice | list[int] = slice(None) if features is None else features

    def inputs(self, state: Tensor) -> Tensor:
        """Return what the network sees, ``(l, n, in)``."""
        return torch.cat([state[..., self.features], self.action], -1)

    def __call__(self, state: Tensor) -> Tensor:
        """Return the rate of change ``(l, n, S)``."""
        value = residual(self.inputs(state), self.network)
        if self.turned:
            value = (to_world(state) @ value.unsqueeze(-1)).squeeze(-1)
        return self.nominal(state) + value

    def finish(self, state: Tensor) -> Tensor:
        return self.nominal.finish(state)

    def tangent(self, state: Tensor, through: Tensor) -> tuple[Tensor, Tensor]:
        rate, turn = self.nominal.tangent(state, through)
        value, slope = residual_slope(self.inputs(state), self.network)
        actions = self.action.shape[-1]
        if self.turned:
            matrix = to_world(state)
            turn = turn + to_world_slope(state, value) @ through
            value, slope = (matrix @ value.unsqueeze(-1)).squeeze(-1), matrix @ slope
        by_state, by_action = slope.split([slope.shape[-1] - actions, actions], -1)
        turn = turn + by_state @ through[..., self.features, :]
        turn[..., -actions:] += by_action
        return rate + value, turn
