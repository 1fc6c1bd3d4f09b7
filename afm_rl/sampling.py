"""Sampling of training points."""

from __future__ import annotations

import torch
from torch import Tensor


def uniform(low: Tensor, high: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw ``count`` points uniformly in a box: ``(count, D)``.

    >>> uniform(torch.zeros(2), torch.ones(2), 5, torch.Generator()).shape
    torch.Size([5, 2])
    """
    return low + (high - low) * torch.rand(count, len(low), generator=generator)
