"""The last moments of flights."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.mission_state import MissionState


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


class FlightWindow(MissionState):
    """Keeps the latest rows.

    >>> window = FlightWindow()
    >>> for _ in range(3):
    ...     window.gather(Rows(*torch.ones(3, 4, 1, 2, 1), torch.ones(4, 1, 2).bool()), 5)
    >>> window.size, window.parts.state.shape
    (5, torch.Size([4, 1, 5, 1]))
    """

    def __init__(self) -> None:
        super().__init__(Rows(*(torch.zeros(0) for _ in Rows._fields)))

    @property
    def size(self) -> int:
        """Number of rows, R."""
        return self.parts.counts.shape[-1]

    def gather(self, rows: Rows, most: int) -> None:
        """Add rows and keep the latest ``most``; those that do not count become zeros."""
        counts = rows.counts.unsqueeze(-1)
        state, action, after = (torch.where(counts, part, 0.0) for part in rows[:3])
        rows = Rows(state, action, after, rows.counts)
        if self.size:
            rows = Rows(*(torch.cat(pair, 2) for pair in zip(self.parts, rows, strict=True)))
        self.keep(Rows(*(part[:, :, -most:].contiguous() for part in rows)))

    def clear(self) -> None:
        """Forget all rows."""
        self.keep(Rows(*(torch.zeros(0) for _ in Rows._fields)))
