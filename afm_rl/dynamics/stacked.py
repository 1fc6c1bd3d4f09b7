"""Many small networks of one shape as single batched matrix products."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

SLOPE = 0.01  # of the LeakyReLU


def stacked_mlp(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """Run M perceptrons with LeakyReLU on M batches: ``(M, N, in) -> (M, N, out)``.

    Args:
        inputs: ``(M, N, in)``.
        weights: one ``(M, in, out)`` per layer.
        biases: one ``(M, 1, out)`` per layer.

    >>> stacked_mlp(torch.ones(2, 7, 3), [torch.ones(2, 3, 1)], [torch.zeros(2, 1, 1)])[0, 0]
    tensor([3.])
    """
    hidden = torch.baddbmm(biases[0], inputs, weights[0])
    for weight, bias in zip(weights[1:], biases[1:], strict=True):
        hidden = F.leaky_relu(hidden, SLOPE, inplace=True)
        hidden = torch.baddbmm(bias, hidden, weight)
    return hidden


def stacked_mlp_tangent(
    inputs: Tensor, tangents: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Tensor:
    """Push A tangent vectors through the networks of :func:`stacked_mlp`.

    Args:
        inputs: ``(M, N, in)``.
        tangents: ``(A, in)``, the same for every row.
        weights: one ``(M, in, out)`` per layer.
        biases: one ``(M, 1, out)`` per layer.

    Returns:
        Directional derivatives ``(M, N, A, out)``.
    """
    moved = torch.cat([inputs.unsqueeze(2), tangents.expand(*inputs.shape[:2], *tangents.shape)], 2)
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        rows = moved.shape[1:3]
        moved = torch.bmm(moved.flatten(1, 2), weight).unflatten(1, rows)
        if layer < len(weights) - 1:
            value = moved[:, :, :1] + bias.unsqueeze(2)
            slope = torch.where(value > 0, 1.0, SLOPE).to(value.dtype)
            moved = torch.cat([value, moved[:, :, 1:]], 2) * slope
    return moved[:, :, 1:]
