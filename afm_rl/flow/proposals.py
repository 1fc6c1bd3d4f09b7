"""What a context flow asks about, and how it chooses among its samples."""

from __future__ import annotations

import torch
from torch import Tensor

PROBES = 32  # actions whose effects are asked for the reach
APART = 0.05  # half ranges: so far to either side effects are compared for their slopes
DAMPING = 0.03  # a slope below says little about how far to go
LEAST_REACH = 0.01  # half ranges


def source_points_of(count: int, size: int) -> Tensor:
    """Return normal points ``(count, A)``, the same ones always; each has its opposite."""
    half = torch.randn((count + 1) // 2, size, generator=torch.Generator().manual_seed(0))
    return torch.cat([half, -half])[:count]


def probes_of(size: int) -> Tensor:
    """Return actions ``(P, A)`` in half ranges: ends of the axes, and between them.

    >>> probes_of(1)[:2].tolist()
    [[1.0], [-1.0]]
    """
    ends = torch.cat([torch.eye(size), -torch.eye(size)])
    inner = torch.quasirandom.SobolEngine(size).draw(max(1, PROBES - 2 * size))
    return torch.cat([ends, 2 * inner - 1])


def nearest_of(proposals: Tensor, effects: Tensor, wanted: Tensor, reach: Tensor) -> Tensor:
    """Return the proposal ``(*B, A)`` whose effect comes nearest to what is wanted.

    Squared errors count by one over what can be had at all on their axis: midway between
    absolute ones, which forget an axis of which little can be had, and relative ones, for which
    it is everything.

    Args:
        proposals: ``(*B, P, A)``.
        effects: what they are expected to be worth, ``(*B, P, A)``.
        wanted: ``(*B, A)``.
        reach: half of the range of effects that can be had, ``(*B, A)``.

    >>> proposals, effects = torch.tensor([[1.0], [2.0]]), torch.tensor([[0.5], [0.9]])
    >>> nearest_of(proposals, effects, torch.ones(1), torch.ones(1))
    tensor([2.])
    """
    errors = (effects - wanted.unsqueeze(-2)).square()
    cost = (errors / reach.clamp_min(LEAST_REACH).unsqueeze(-2)).sum(-1)
    best = cost.argmin(-1)[..., None, None]
    return proposals.take_along_dim(best, -2).squeeze(-2)


def beside(action: Tensor) -> Tensor:
    """Return neighbours ``(*B, 2 A, A)`` of an action ``(*B, A)``: up each axis, then down.

    >>> beside(torch.zeros(1))
    tensor([[ 0.0500],
            [-0.0500]])
    """
    step = APART * torch.eye(action.shape[-1], device=action.device, dtype=action.dtype)
    return action.unsqueeze(-2) + torch.cat([step, -step])


def newton_step(
    action: Tensor, effect: Tensor, around: Tensor, wanted: Tensor, most: float
) -> Tensor:
    r"""Return an action ``(*B, A)`` whose effect is nearer to what is wanted.

    One damped Newton step in the box, with slopes S from differences:

    .. math:: u \leftarrow u + (S^\top S + \rho^2 I)^{-1} S^\top (w - \hat T(u))

    Args:
        action: u, ``(*B, A)``.
        effect: what it is expected to be worth, ``(*B, A)``.
        around: what its neighbours are, see :func:`beside`, ``(*B, 2 A, A)``.
        wanted: w, ``(*B, A)``.
        most: longest step along an axis.

    >>> action, wanted = torch.zeros(1), torch.tensor([0.1])
    >>> newton_step(action, -2 * action, -2 * beside(action), wanted, 1.0).round(decimals=3)
    tensor([-0.0500])
    """
    up, down = around.chunk(2, -2)
    slope = (up - down) / (2 * APART)  # (*B, A, A), transposed
    ridge = DAMPING**2 * torch.eye(action.shape[-1], device=action.device, dtype=action.dtype)
    miss = (slope * (wanted - effect).unsqueeze(-2)).sum(-1)
    step = torch.linalg.solve(slope @ slope.mT + ridge, miss)
    return (action + step.clamp(-most, most)).clamp(-1.0, 1.0)
