"""Sampling of training points."""

from __future__ import annotations

import torch
from torch import Tensor


def uniform(low: Tensor, high: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw ``count`` points uniformly in a box: ``(count, D)``.

    >>> uniform(torch.zeros(2), torch.ones(2), 5, torch.Generator()).shape
    torch.Size([5, 2])
    """
    share = torch.rand(count, len(low), generator=generator)  # the same on every device
    return low + (high - low) * share.to(low.device)


def draw_states(
    states: tuple[Tensor, Tensor] | Tensor, count: int, generator: torch.Generator
) -> Tensor:
    """Draw ``count`` states from a box or, with replacement, from a pool: ``(count, S)``.

    Args:
        states: lowest and highest state, ``(S,)`` each; or observed states, ``(P, S)``.
        count: how many.
        generator: of the numbers.

    >>> draw_states(torch.tensor([[7.0, 8.0]]), 2, torch.Generator()).tolist()
    [[7.0, 8.0], [7.0, 8.0]]
    """
    if isinstance(states, Tensor):
        return states[torch.randint(len(states), (count,), generator=generator).to(states.device)]
    return uniform(*states, count, generator)
