"""Small networks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

SHARP = 5.0  # of logits: shares that are all or nothing are soon learnt


def mlp(sizes: Sequence[int], generator: torch.Generator) -> nn.Sequential:
    """Return a perceptron with ELU between its layers.

    The initial weights are those of ``nn.Linear``, but drawn from ``generator``.

    >>> mlp([3, 8, 2], torch.Generator())[-1].out_features
    2
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in zip(sizes[:-1], sizes[1:], strict=True):
        linear = nn.utils.skip_init(nn.Linear, fan_in, fan_out)
        for parameter in linear.parameters():
            bound = 1 / math.sqrt(fan_in)
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
        layers += [linear, nn.ELU()]
    return nn.Sequential(*layers[:-1])


def blend(output: Tensor, guesses: Tensor) -> Tensor:
    r"""Return a network's own answer and G guesses of others in the shares it gives them.

    .. math:: s_0\,y + \sum_g s_g\,y_g,\qquad s = \mathrm{softmax}(5 \ell)

    each component for itself: a mixture of experts (Jacobs et al. 1991) that comes as near as need
    be to a guess that is exact, which no network of this size does by computing it.

    Args:
        output: y and the logits, ``(*B, (G + 2) A)``.
        guesses: ``(*B, G, A)``.

    >>> blend(torch.tensor([1.0, 0.0, 9.0]), torch.tensor([[2.0]])).round(decimals=2)
    tensor([2.])
    """
    count, size = guesses.shape[-2:]
    own, logits = output.split([size, (count + 1) * size], -1)
    shares = (SHARP * logits).unflatten(-1, (count + 1, size)).softmax(-2)
    return (shares * torch.cat([own.unsqueeze(-2), guesses], -2)).sum(-2)
