"""Small networks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import nn


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
