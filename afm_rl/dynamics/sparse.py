"""Initial weights of stacked networks."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from afm_rl.errors import check_number


def uniform_layer(
    members: int, fan_in: int, fan_out: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw weights ``(M, in, out)`` and biases ``(M, 1, out)`` as ``nn.Linear`` does."""
    drawn = _uniform(members, fan_in + 1, fan_out, fan_in, generator)
    return drawn[:, :fan_in].clone(), drawn[:, fan_in:].clone()


def sparse_layer(
    members: int, fan_in: int, fan_out: int, generator: torch.Generator, density: float = 0.1
) -> tuple[Tensor, Tensor]:
    r"""Draw weights ``(M, in, out)`` of which most are zero; biases ``(M, 1, out)`` are.

    Each unit keeps a random tenth of its incoming weights, at least one, drawn from
    :math:`U(\pm 1/\sqrt{\text{fan-in}})` (Elsayed et al. 2024, section 3): units that look
    at different inputs disturb each other less when they learn from one sample at a time.

    Args:
        members: number of networks, M.
        fan_in: inputs of the layer.
        fan_out: units of the layer.
        generator: source of randomness.
        density: share of the weights kept, in (0, 1].

    Raises:
        ConfigurationError: for a density out of range.

    >>> weight, bias = sparse_layer(2, 50, 7, torch.Generator().manual_seed(0))
    >>> (weight != 0).sum(1).unique(), bias.abs().sum()
    (tensor([5]), tensor(0.))
    """
    check_number("density", density, low=0.0, high=1.0, open_low=True)
    keep = max(1, round(density * fan_in))
    weight = _uniform(members, fan_in, fan_out, fan_in, generator)
    rank = torch.rand(weight.shape, generator=generator).argsort(1).argsort(1)
    return torch.where(rank < keep, weight, 0.0), torch.zeros(members, 1, fan_out)


def _uniform(
    members: int, rows: int, columns: int, fan_in: int, generator: torch.Generator
) -> Tensor:
    uniform = torch.rand(members, rows, columns, generator=generator)
    return (2 * uniform - 1) * (1 / math.sqrt(fan_in))
