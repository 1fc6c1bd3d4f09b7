"""Which of the flow's samples is executed."""

from __future__ import annotations

import torch
from torch import Tensor

PROBES = 32  # actions whose effects are asked for the reach
LEAST_REACH = 0.01  # shares of the largest action


def source_points_of(count: int, size: int) -> Tensor:
    """Return normal points ``(count, A)``, the same ones always; each has its opposite."""
    half = torch.randn((count + 1) // 2, size, generator=torch.Generator().manual_seed(0))
    return torch.cat([half, -half])[:count]


def probes_of(size: int) -> Tensor:
    """Return actions ``(P, A)``, shares of the largest action: ends of the axes, and between them.

    >>> probes_of(1)[:2].tolist()
    [[1.0], [-1.0]]
    """
    ends = torch.cat([torch.eye(size), -torch.eye(size)])
    inner = torch.quasirandom.SobolEngine(size).draw(max(1, PROBES - 2 * size))
    return torch.cat([ends, 2 * inner - 1])


def nearest_of(effects: Tensor, wanted: Tensor, reach: Tensor) -> Tensor:
    """Return which effect comes nearest to what is wanted, ``(*B, 1, 1)``.

    Errors are relative to the achievable range of their axis: an axis with a small range counts
    as much as any other.

    Args:
        effects: the predicted effects of proposals, ``(*B, P, A)``.
        wanted: ``(*B, A)``.
        reach: half of the range of achievable effects, ``(*B, A)``.

    >>> nearest_of(torch.tensor([[0.5], [0.9]]), torch.ones(1), torch.ones(1))
    tensor([[1]])
    """
    errors = (effects - wanted.unsqueeze(-2)) / reach.clamp_min(LEAST_REACH).unsqueeze(-2)
    return errors.square().sum(-1).argmin(-1)[..., None, None]
