"""The last moments of flights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.learning.updater import ABSURD


class Rows(NamedTuple):
    """Steps of flights: l missions, n flights of each, R steps."""

    state: Tensor
    """``(l, n, R, S)``."""
    action: Tensor
    """``(l, n, R, A)``."""
    after: Tensor
    """The next state, ``(l, n, R, S)``."""
    counts: Tensor
    """Whether the step is to be learnt from, ``(l, n, R)``; the others hold zeros."""


def sound_rows(state: Tensor, action: Tensor, after: Tensor, counts: Tensor) -> Rows:
    """Blank steps that are not finite or absurdly large, and do not count them.

    >>> rows = sound_rows(*torch.tensor([[[1.0]], [[float("inf")]], [[1.0]]]), torch.tensor([True]))
    >>> rows.counts, rows.action
    (tensor([False]), tensor([[0.]]))
    """
    parts = (state, action, after)
    for part in parts:
        counts = counts & (part.abs() < ABSURD).all(-1)  # false for NaN
    state, action, after = (torch.where(counts.unsqueeze(-1), part, 0.0) for part in parts)
    return Rows(state, action, after, counts)


class FlightWindow(nn.Module):
    """Keeps the latest rows, as buffers, so that a checkpoint of the missions holds them.

    The buffers are not persistent: they belong to flights, not to a stored model.

    >>> window = FlightWindow()
    >>> for _ in range(3):
    ...     window.gather(sound_rows(*torch.ones(3, 4, 1, 2, 1), torch.ones(4, 1, 2).bool()), 5)
    >>> window.size, window.rows.state.shape
    (5, torch.Size([4, 1, 5, 1]))
    """

    def __init__(self) -> None:
        super().__init__()
        self.clear()

    @property
    def size(self) -> int:
        """Number of rows, R."""
        return self.get_buffer("counts").shape[-1]

    @property
    def rows(self) -> Rows:
        """What is kept."""
        return Rows(*(self.get_buffer(name) for name in Rows._fields))

    def gather(self, rows: Rows, most: int) -> None:
        """Add rows and keep the latest ``most``."""
        if self.size:
            rows = Rows(*(torch.cat(pair, 2) for pair in zip(self.rows, rows, strict=True)))
        self._keep(Rows(*(part[:, :, -most:].contiguous() for part in rows)))

    def clear(self) -> None:
        """Forget all rows."""
        self._keep(Rows(*(torch.zeros(0) for _ in Rows._fields)))

    def select_(self, index: Tensor) -> None:
        """Keep the missions in ``index``."""
        if self.size:
            self._keep(Rows(*(part[index] for part in self.rows)))

    def _keep(self, rows: Rows) -> None:
        for name, part in zip(Rows._fields, rows, strict=True):
            self.register_buffer(name, part, persistent=False)
