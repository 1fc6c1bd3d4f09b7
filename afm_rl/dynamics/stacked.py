"""Many small networks of one shape as single batched matrix products: weights, runs, statistics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import torch
import torch.nn.functional as F  # noqa: N812
from annotated_types import Le
from torch import Tensor, nn

from afm_rl.errors import ConfigurationError, check_count
from afm_rl.options import Count, Positive, options

SLOPE = 0.01  # of the LeakyReLU
EPS = 1e-5  # of the layer norm: torch's own
LEAST_STD = 1e-8  # in the features' units


def stacked_mlp(
    inputs: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    layer_norm: bool = False,
) -> Tensor:
    """Run M perceptrons with LeakyReLU on M batches: ``(M, N, in) -> (M, N, out)``.

    Each layer runs in the precision of its parameters, weights ``(M, in, out)`` and biases
    ``(M, 1, out)``; with ``layer_norm`` units are standardised before each LeakyReLU.

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
    """Return the networks' derivatives along tangents ``(A, in)``, ``(M, N, A, out)``."""
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


def uniform_layer(
    members: int, fan_in: int, fan_out: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw weights ``(M, in, out)`` and biases ``(M, 1, out)`` as ``nn.Linear`` does."""
    drawn = _uniform(members, fan_in + 1, fan_out, fan_in, generator)
    return drawn[:, :fan_in].clone(), drawn[:, fan_in:].clone()


@options("")
def sparse_layer(
    members: int,
    fan_in: int,
    fan_out: int,
    generator: torch.Generator,
    density: Annotated[Positive, Le(1), "share of weights that are not zero"] = 0.1,
) -> tuple[Tensor, Tensor]:
    r"""Draw weights ``(M, in, out)`` of which most are zero; biases ``(M, 1, out)`` are.

    Each unit keeps a random tenth of its incoming weights, at least one, drawn from
    :math:`U(\pm 1/\sqrt{\text{fan-in}})` (Elsayed et al. 2024, section 3): units that look
    at different inputs disturb each other less when they learn from one sample at a time.

    >>> weight, bias = sparse_layer(2, 50, 7, torch.Generator().manual_seed(0))
    >>> (weight != 0).sum(1).unique(), bias.abs().sum()
    (tensor([5]), tensor(0.))
    """
    keep = max(1, round(density * fan_in))
    weight = _uniform(members, fan_in, fan_out, fan_in, generator)
    rank = torch.rand(weight.shape, generator=generator).argsort(1).argsort(1)
    return torch.where(rank < keep, weight, 0.0), torch.zeros(members, 1, fan_out)


def _uniform(
    members: int, rows: int, columns: int, fan_in: int, generator: torch.Generator
) -> Tensor:
    uniform = torch.rand(members, rows, columns, generator=generator)
    return (2 * uniform - 1) * (1 / math.sqrt(fan_in))


class RunningStats(nn.Module):
    r"""Standardise by the mean and standard deviation of everything seen so far.

    Welford's method, one sample :math:`x` at a time:

    .. math:: n \leftarrow n + 1,\quad d = x - m,\quad m \leftarrow m + d / n,\quad
              q \leftarrow q + d\,(x - m),\quad \sigma^2 = q / (n - 1)

    and Chan's generalisation where several arrive together. Streams in the leading
    dimensions ``L`` are independent of each other.

    Args:
        lead: leading dimensions, L.

    >>> stats = RunningStats(1)
    >>> for x in (1.0, 2.0, 6.0):
    ...     stats.update_(torch.tensor([x]))
    >>> stats.mean, stats.std, stats(torch.tensor([3.0]))
    (tensor([3.]), tensor([2.6458]), tensor([0.]))
    """

    mean: Tensor
    """Mean ``(*L, D)``."""
    scatter: Tensor
    """Sum of squared deviations, q ``(*L, D)``."""
    count: Tensor
    """Number of samples, n ``(*L, 1)``."""

    @options("")
    def __init__(
        self,
        size: Annotated[Count, "features, D"],
        lead: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.size = size
        for name, width in (("mean", size), ("scatter", size), ("count", 1)):
            self.register_buffer(name, torch.zeros(*lead, width))

    @property
    def lead(self) -> torch.Size:
        """Leading dimensions of the streams."""
        return self.mean.shape[:-1]

    @property
    def std(self) -> Tensor:
        """Standard deviation ``(*L, D)``; 1 before the second sample."""
        variance = self.scatter / (self.count - 1).clamp_min(1)
        return torch.where(self.count > 1, variance.sqrt().clamp_min(LEAST_STD), 1.0)

    def forward(self, values: Tensor) -> Tensor:
        """Standardise ``(*L, *N, D)``."""
        further = [1] * (values.dim() - self.mean.dim())
        mean, std = (x.reshape(*self.lead, *further, self.size) for x in (self.mean, self.std))
        return (values - mean) / std

    def start_(self, mean: Tensor, std: Tensor, count: int) -> None:
        """Begin as if ``count`` samples of this mean and deviation ``(D,)`` had been seen."""
        self.count.fill_(check_count("count", count))
        self.mean.copy_(mean)
        self.scatter.copy_(std.square() * (count - 1))

    @torch.no_grad()
    def update_(self, values: Tensor, where: Tensor | None = None) -> None:
        """Take in finite samples ``(*L, *N, D)``, those of ``where`` ``(*L, *N)``; all if None."""
        batch = values.shape[:-1]
        if batch[: len(self.lead)] != self.lead or values.shape[-1:] != (self.size,):
            raise ConfigurationError(
                f"values of shape {tuple(values.shape)}: expected "
                f"({', '.join(map(str, (*self.lead, '...', self.size)))})"
            )
        if where is None:
            where = torch.ones(batch, dtype=torch.bool, device=values.device)
        elif where.shape != batch:
            raise ConfigurationError(
                f"where of shape {tuple(where.shape)}: expected {tuple(batch)}"
            )
        counts = where.reshape(*self.lead, -1, 1)
        values = values.reshape(*self.lead, -1, self.size).to(self.mean)
        values = torch.where(counts, values, 0.0)  # NaN times zero would be NaN
        new = counts.sum(-2).to(self.count)
        centre = values.sum(-2) / new.clamp_min(1)
        spread = torch.where(counts, values - centre.unsqueeze(-2), 0.0).square().sum(-2)
        total = (self.count + new).clamp_min(1)
        gap = torch.where(new > 0, centre - self.mean, 0.0)
        self.scatter += spread + gap.square() * self.count * new / total
        self.mean += gap * new / total
        self.count += new
