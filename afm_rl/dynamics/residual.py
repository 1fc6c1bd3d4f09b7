"""Small networks that add to a rate of change, and their derivatives."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor


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
    r"""Make a network of standard normal numbers: Xavier-uniform weights, no biases.

    :math:`w = \sqrt{6 / (n_\mathrm{in} + n_\mathrm{out})}\;\mathrm{erf}(z / \sqrt 2)`, which is
    uniform (Glorot & Bengio 2010), so that streams of normal numbers serve.

    Args:
        numbers: z, ``(*L, hidden * (inputs + outputs))``.
        inputs: size of the input.
        hidden: number of hidden units.
        outputs: size of the output.

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
