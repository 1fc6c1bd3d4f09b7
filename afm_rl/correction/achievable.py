"""What to do when an action cannot be had in full."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from torch import Tensor

LIMIT = 4.0  # shares of the largest action: effects beyond are clipped
MODES = ("mixed", "direction", "clip")
Saturation = Annotated[
    Literal["mixed", "direction", "clip"],
    "mixed: slower if under 15 %; direction: do it slower; clip: cut each component",
]
LEAST = 0.15  # share of a component that must be had for "mixed" to clip it
LITTLE = 0.3  # share of the box that must be reached for plans to keep to it
TRIED = 0.1  # share of the box that must have been tried to know that little can be reached
DEAD = 0.025  # share of which nothing can be had


def saturate(unit: Tensor, mode: str, dim: int = -1) -> Tensor:
    """Bring an action ``(*B, A)``, in shares of the largest one, into the box [-1, 1]^A.

    The axes are in the dimension ``dim``.

    ``"clip"`` cuts each component for itself; ``"direction"`` shrinks all alike, so that the
    robot does the same thing slower: the ratio of turning to driving is kept. ``"mixed"`` does it
    slower where of half of the components, at least, less than 15 % can be had, and clips else.

    >>> saturate(torch.tensor([0.5, 2.0]), "direction")
    tensor([0.2500, 1.0000])
    """
    if mode == "clip":
        return unit.clamp(-1.0, 1.0)
    excess = unit.abs().clamp_min(1.0)
    slower = unit / excess.amax(dim, keepdim=True)
    if mode == "direction":
        return slower
    return torch.where(_half(excess * LEAST > 1.0, dim), slower, unit.clamp(-1.0, 1.0))


def _half(mask: Tensor, dim: int = -1) -> Tensor:
    """Return whether a mask holds for half of the axes at least: one of two, or ten of twenty."""
    return mask.to(torch.float32).mean(dim, keepdim=True) >= 0.5


def attainable(unit: Tensor, low: Tensor, high: Tensor, mode: str) -> Tensor:
    """Return the part of a planned action ``(*B, A)`` that should be had, in shares of the largest.

    Args:
        unit: the planned action.
        low: lowest effect that can be had, ``(*B, A)``.
        high: highest.
        mode: see :func:`saturate`; ``"clip"`` still asks for all of it.

    >>> half, most = torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 0.5])
    >>> attainable(torch.tensor([0.5, -1.0]), half, most, "direction")
    tensor([ 0.2500, -0.5000])
    """
    if mode == "clip":
        return unit
    limit = torch.where(unit < 0, -low, high).clamp_min(0.0)
    share = limit / unit.abs().clamp_min(1e-6)
    share = torch.where(high - low < 2 * DEAD, 1.0, share)  # no slowness helps there
    slower = unit * share.amin(-1, keepdim=True).clamp_max(1.0)
    return slower if mode == "direction" else torch.where(_half(share < LEAST), slower, unit)


def extend(reach: Tensor, box: Tensor, tried: Tensor) -> Tensor:
    """Return the bounds ``(*B, 2, A)`` that plans should keep, given what can be reached.

    Usually these are the effect bounds. If they are less than 30 % of the action bounds, the result
    is the action bounds, and plans are clipped or scaled afterwards, because with such small bounds
    a planner finds no way a few steps ahead. There are two exceptions: no effect can be reached, or
    only a small part of the actions was executed; then plans within the effect bounds explore more.

    Args:
        reach: lowest and highest effect, ``(*B, 2, A)``.
        box: lowest and highest action, ``(*B, 2, A)``.
        tried: range of the actions that were tried, ``(*B, A)``.

    >>> box, all_of_it = torch.tensor([[-1.0], [1.0]]), torch.tensor([2.0])
    >>> [extend(share * box, box, all_of_it)[1].item() for share in (0.0, 0.25, 0.5, 2.0)]
    [0.0, 1.0, 0.5, 2.0]
    """
    width = box.diff(dim=-2)
    share = reach.diff(dim=-2) / width
    little = (share > DEAD) & (share < LITTLE) & (tried.unsqueeze(-2) > TRIED * width)
    (low, high), (least, most) = reach.unbind(-2), box.unbind(-2)
    low, high = torch.where(low < least, low, least), torch.where(high > most, high, most)
    return torch.where(little, torch.stack([low, high], -2), reach)
