"""Many small networks of one shape as single batched matrix products."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

SLOPE = 0.01  # of the LeakyReLU
EPS = 1e-5  # of the layer norm: torch's own


def stacked_mlp(
    inputs: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    layer_norm: bool = False,
) -> Tensor:
    """Run M perceptrons with LeakyReLU on M batches: ``(M, N, in) -> (M, N, out)``.

    Each layer runs in the precision of its parameters.

    Args:
        inputs: ``(M, N, in)``.
        weights: one ``(M, in, out)`` per layer.
        biases: one ``(M, 1, out)`` per layer.
        layer_norm: standardise the units of a layer before each LeakyReLU.

    >>> stacked_mlp(torch.ones(2, 7, 3), [torch.ones(2, 3, 1)], [torch.zeros(2, 1, 1)])[0, 0]
    tensor([3.])
    """
    hidden = _affine(inputs, weights[0], biases[0])
    for weight, bias in zip(weights[1:], biases[1:], strict=True):
        if layer_norm:
            hidden = F.layer_norm(hidden, hidden.shape[-1:], eps=EPS)
        hidden = F.leaky_relu(hidden, SLOPE, inplace=True)
        hidden = _affine(hidden.to(weight.dtype), weight, bias)
    return hidden


def _affine(inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return ``inputs @ weight + bias``, whichever way is faster."""
    if weight.dtype is torch.bfloat16:  # adding in it is slow: the product does it on the way
        return torch.baddbmm(bias, inputs, weight)
    return torch.bmm(inputs, weight).add_(bias)  # baddbmm would copy the bias first


def stacked_mlp_tangent(
    inputs: Tensor,
    tangents: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    layer_norm: bool = False,
) -> Tensor:
    """Push A tangent vectors through the networks of :func:`stacked_mlp`.

    Args:
        inputs: ``(M, N, in)``.
        tangents: ``(A, in)``, the same for every row.
        weights: one ``(M, in, out)`` per layer.
        biases: one ``(M, 1, out)`` per layer.
        layer_norm: standardise the units of a layer before each LeakyReLU.

    Returns:
        Directional derivatives ``(M, N, A, out)``.
    """
    axes = tangents.unsqueeze(1).expand(len(inputs), -1, *inputs.shape[1:])
    moved = torch.cat([inputs.unsqueeze(1), axes], 1)  # (M, 1 + A, N, in): values, then tangents
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        planes = moved.shape[1:3]
        moved = torch.bmm(moved.flatten(1, 2), weight).unflatten(1, planes)
        if layer < len(weights) - 1:
            value = moved[:, :1].add_(bias.unsqueeze(1))
            if layer_norm:
                moved = torch.cat(_layer_norm_tangent(value, moved[:, 1:]), 1)
            moved *= torch.where(moved[:, :1] > 0, 1.0, SLOPE).to(moved.dtype)
    return moved[:, 1:].transpose(1, 2)


def _layer_norm_tangent(value: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
    """Return a layer norm's value ``(*B, D)`` and its tangents ``(*B, D)``.

    With ``n = (v - mean v) / s``, ``s`` the root of the variance plus a small constant:
    ``dn = (dv - mean dv - n mean(n dv)) / s``.
    """
    centred = value - value.mean(-1, keepdim=True)
    scale = (centred.square().mean(-1, keepdim=True) + EPS).rsqrt()
    normed = centred * scale
    along = (normed * change).mean(-1, keepdim=True)
    return normed, (change - change.mean(-1, keepdim=True) - normed * along) * scale
