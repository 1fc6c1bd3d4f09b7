"""Gain and offset of each actuator, from pairs that differ in what they tell."""

from __future__ import annotations

import torch
from torch import Tensor

FLOOR = 0.1  # half ranges: standard deviation that even the sharpest pair is given
CLOSE = 0.2  # half ranges: a pair this far from the fit counts half (Cauchy)
ROUNDS = 3  # of reweighting
PRIOR = (0.5, 2.0)  # weight of gain 1 and offset 0; a sharp pair has one of 100
LEAST = 0.05  # smallest gain that is divided by


def weigh_pairs(std: Tensor, valid: Tensor, forgetting: float) -> Tensor:
    r"""Return the weight of each axis of a pair: :math:`\lambda^k / (\sigma^2 + 0.1^2)` at age k.

    Args:
        std: standard deviation of the effective action in half ranges, ``(*B, K, A)``, oldest
            first.
        valid: 1 where there is a pair, else 0, ``(*B, K, 1)``.
        forgetting: λ, in (0, 1].

    >>> weigh_pairs(torch.tensor([[0.0], [0.3]]), torch.ones(2, 1), 0.8).flatten()
    tensor([80., 10.])
    """
    age = torch.arange(valid.shape[-2] - 1, -1, -1, device=std.device, dtype=std.dtype)
    return valid * (forgetting**age).unsqueeze(-1) / (std.square() + FLOOR**2)


def fit_gain_offset(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u + b`, each axis for itself.

    Weighted least squares with a weak prior at g = 1, b = 0, and pairs far from the fit counting
    less (Cauchy's weights, :math:`1 / (1 + (r / 0.2)^2)` at a residual of r half ranges).

    Args:
        executed: u in half ranges, ``(*B, K, A)``.
        effective: what it turned out to be, ``(*B, K, A)``.
        weight: of each axis of each pair, ``(*B, K, A)``, see :func:`weigh_pairs`.

    Returns:
        Gains, none smaller than 0.05 in size, and offsets, ``(*B, A)`` each.

    >>> u = torch.tensor([[0.5], [-1.0], [0.2]])
    >>> gain, offset = fit_gain_offset(u, 0.1 - 2 * u, torch.full((3, 1), 1e4))
    >>> gain.round(decimals=2), offset.round(decimals=2)
    (tensor([-2.]), tensor([0.1000]))
    """
    terms = torch.stack(
        [executed * executed, executed, torch.ones_like(executed), executed * effective, effective]
    )
    count = weight
    for left in reversed(range(ROUNDS)):
        square, mixed, ones, cross, sums = (count * terms).sum(-2)
        square, cross, ones = square + PRIOR[0], cross + PRIOR[0], ones + PRIOR[1]
        determinant = square * ones - mixed.square()
        gain = (ones * cross - mixed * sums) / determinant
        offset = (square * sums - mixed * cross) / determinant
        if left:
            rest = effective - gain.unsqueeze(-2) * executed - offset.unsqueeze(-2)
            count = weight / (1 + (rest / CLOSE).square())
    return gain.abs().clamp_min(LEAST).copysign(gain), offset


def invert_gain_offset(gain: Tensor, offset: Tensor, unit: Tensor) -> Tensor:
    """Return the action ``(*B, A)`` whose effect under :func:`fit_gain_offset` is ``unit``."""
    return (unit - offset) / gain
