"""Running mean and standard deviation of a stream."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from afm_rl.errors import ConfigurationError, check_count, check_number


class RunningStats(nn.Module):
    r"""Standardise by the mean and standard deviation of everything seen so far.

    Welford's method, one sample :math:`x` at a time:

    .. math:: n \leftarrow n + 1,\quad d = x - m,\quad m \leftarrow m + d / n,\quad
              q \leftarrow q + d\,(x - m),\quad \sigma^2 = q / (n - 1)

    and Chan's generalisation where several arrive together. Streams in the leading
    dimensions ``L`` are independent of each other.

    Args:
        size: number of features, D.
        lead: leading dimensions, L.
        min_std: least standard deviation, > 0, in the features' units.

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

    def __init__(self, size: int, lead: Sequence[int] = (), min_std: float = 1e-8) -> None:
        super().__init__()
        self.size = check_count("size", size)
        self.min_std = check_number("min_std", min_std, low=0.0, open_low=True)
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
        return torch.where(self.count > 1, variance.sqrt().clamp_min(self.min_std), 1.0)

    def forward(self, values: Tensor) -> Tensor:
        """Standardise ``(*L, *N, D)``."""
        further = [1] * (values.dim() - self.mean.dim())
        mean, std = (x.reshape(*self.lead, *further, self.size) for x in (self.mean, self.std))
        return (values - mean) / std

    def start_(self, mean: Tensor, std: Tensor, count: int) -> None:
        """Begin as if ``count`` samples of this mean and deviation ``(D,)`` had been seen.

        Raises:
            ConfigurationError: for a count below 1.
        """
        self.count.fill_(check_count("count", count))
        self.mean.copy_(mean)
        self.scatter.copy_(std.square() * (count - 1))

    @torch.no_grad()
    def update_(self, values: Tensor, where: Tensor | None = None) -> None:
        """Take in samples.

        Args:
            values: ``(*L, *N, D)``; must be finite where they count.
            where: ``(*L, *N)`` boolean, which samples count; None for all.

        Raises:
            ConfigurationError: if the shapes do not fit.
        """
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

    def expand_(self, streams: int) -> RunningStats:
        """Give each of ``streams`` statistics of its own to go on with, in place."""
        for name, value in self.named_buffers():
            setattr(self, name, value.expand(streams, *value.shape).clone())
        return self

    def select_(self, index: Tensor) -> RunningStats:
        """Keep the streams in ``index`` of the first leading dimension, in place."""
        for name, value in self.named_buffers():
            setattr(self, name, value[index])
        return self
