"""Small networks that add to a rate of change, and their derivatives."""

from __future__ import annotations

import math
from typing import NamedTuple

import roma
import torch
from torch import Tensor

from afm_rl.dynamics.rates import HeldRate


class Network(NamedTuple):
    """One hidden layer of tanh units, one network per leading index."""

    inner: Tensor
    """Weights of the hidden layer, ``(*L, in, hidden)``."""
    inner_bias: Tensor
    """``(*L, 1, hidden)``."""
    outer: Tensor
    """Weights of the output, ``(*L, hidden, out)``."""
    outer_bias: Tensor
    """``(*L, 1, out)``."""


def network_shapes(inputs: int, hidden: int, outputs: int) -> list[tuple[int, int]]:
    """Return the shapes of a :class:`Network`'s tensors, without leading dimensions.

    >>> sum(rows * columns for rows, columns in network_shapes(17, 64, 13))
    1997
    """
    return [(inputs, hidden), (1, hidden), (hidden, outputs), (1, outputs)]


def draw_network(numbers: Tensor, inputs: int, hidden: int, outputs: int) -> Network:
    r"""Make a network of standard normal numbers z: Xavier-uniform weights, no biases.

    :math:`w = \sqrt{6 / (n_\mathrm{in} + n_\mathrm{out})}\;\mathrm{erf}(z / \sqrt 2)`, which is
    uniform (Glorot & Bengio 2010), so that streams of normal numbers serve.

    >>> draw_network(torch.zeros(5, 6), inputs=2, hidden=2, outputs=1).inner.shape
    torch.Size([5, 2, 2])
    """
    spread = torch.erf(numbers / math.sqrt(2))
    weights = []
    for part, (rows, columns) in zip(
        spread.split([inputs * hidden, hidden * outputs], -1),
        ((inputs, hidden), (hidden, outputs)),
        strict=True,
    ):
        weights.append(part.unflatten(-1, (rows, columns)) * math.sqrt(6 / (rows + columns)))
    none = numbers.new_zeros
    lead = numbers.shape[:-1]
    return Network(weights[0], none(*lead, 1, hidden), weights[1], none(*lead, 1, outputs))


def residual(rows: Tensor, network: Network) -> Tensor:
    r"""Return :math:`\tanh(x W_1 + b_1) W_2 + b_2` for rows x, ``(l, n, in) -> (l, n, out)``.

    >>> network = draw_network(torch.zeros(1, 6), 2, 2, 1)
    >>> residual(torch.ones(1, 7, 2), network).shape
    torch.Size([1, 7, 1])
    """
    return torch.baddbmm(network.outer_bias, _units(rows, network), network.outer)


def residual_slope(rows: Tensor, network: Network) -> tuple[Tensor, Tensor]:
    r"""Return :func:`residual` and its derivative ``(l, n, out, in)``.

    .. math:: W_2^\top\,\mathrm{diag}(1 - \tanh^2)\,W_1^\top
    """
    units = _units(rows, network)
    value = torch.baddbmm(network.outer_bias, units, network.outer)
    # One product for all rows: (n * out, hidden) by (hidden, in).
    gain = (1 - units.square()).unsqueeze(-2) * network.outer.mT.contiguous().unsqueeze(1)
    slope = torch.bmm(gain.flatten(1, 2), network.inner.mT)
    return value, slope.unflatten(1, gain.shape[1:3])


def _units(rows: Tensor, network: Network) -> Tensor:
    return torch.baddbmm(network.inner_bias, rows, network.inner).tanh()


VELOCITY, ATTITUDE = slice(3, 6), slice(6, 10)  # of a state, see RigidBodySpace


def to_world(state: Tensor) -> Tensor:
    """Return what turns a rate whose acceleration is along the body's axes: R(q) for the velocity.

    States are ``(*B, 13)``, the matrix ``(*B, 13, 13)``.

    >>> quarter = torch.zeros(13).index_fill(0, torch.tensor([8, 9]), 0.5**0.5)  # about z
    >>> (to_world(quarter) @ torch.arange(13.0))[3:6].round()
    tensor([-4.,  3.,  5.])
    """
    whole = torch.eye(13, dtype=state.dtype, device=state.device)
    matrix = whole.repeat(*state.shape[:-1], 1, 1)
    matrix[..., VELOCITY, VELOCITY] = roma.unitquat_to_rotmat(state[..., ATTITUDE])
    return matrix


def to_world_slope(state: Tensor, rate: Tensor) -> Tensor:
    r"""Return how a rate ``(*B, 13)``, turned, changes with the state, ``(*B, 13, 13)``.

    :math:`\mathrm d(q \otimes a \otimes \bar q) = 2\,\mathrm{vec}(\mathrm dq \otimes a \otimes
    \bar q)` for the acceleration a.
    """
    push = torch.nn.functional.pad(rate[..., VELOCITY], (0, 1)).unsqueeze(-2)
    back = roma.quat_conjugation(state[..., ATTITUDE]).unsqueeze(-2)
    steps = torch.eye(4, dtype=state.dtype, device=state.device)
    slope = state.new_zeros(*state.shape, state.shape[-1])
    turned = roma.quat_product(steps, roma.quat_product(push, back))
    slope[..., VELOCITY, ATTITUDE] = 2 * turned[..., :3].mT
    return slope


class HeldHybrid(HeldRate):
    """:math:`f(x, u) + N([x; u])` and its derivatives, the action ``(l, n, A)`` held.

    The network sees the state coordinates ``features`` (None: all), and speaks in the frame of a
    rigid body if ``turned``, see :func:`to_world`.

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
