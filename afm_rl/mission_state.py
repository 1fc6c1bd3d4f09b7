"""What a part remembers of each mission, kept together so that none of it can be lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn


class MissionState(nn.Module):
    """A named tuple of tensors ``(l, ...)``, a row for each mission.

    Whatever an updater or a planner remembers of single missions belongs into one of these:
    checkpoints of missions save it, and :meth:`follow` cuts it when missions finish. The tensors
    are buffers that are not persistent: they belong to missions, not to a stored model.

    >>> class Errors(NamedTuple):
    ...     latest: Tensor
    ...     total: Tensor
    >>> state = MissionState(Errors(torch.arange(3.0), torch.zeros(3, 7)))
    >>> state.follow(torch.arange(3)), state.follow(torch.tensor([2, 0]))  # mission 1 is finished
    (False, True)
    >>> state.parts.latest, state.parts.total.shape
    (tensor([2., 0.]), torch.Size([2, 7]))
    """

    missions: Tensor

    def __init__(self, parts: NamedTuple) -> None:
        super().__init__()
        self.kind: Any = type(parts)
        self.register_buffer("missions", torch.tensor(-1), persistent=False)
        self._asked: tuple[Tensor | None, int] = None, 0
        self.keep(parts)

    @property
    def parts(self) -> Any:
        """What is kept."""
        return self.kind(*(self.get_buffer(name) for name in self.kind._fields))

    def keep(self, parts: Any) -> None:
        """Replace it."""
        for name, part in zip(self.kind._fields, parts, strict=True):
            self.register_buffer(name, part, persistent=False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> MissionState:
        """Move it to another device; its precision is its own, whatever that of the module."""
        self.keep(self.kind(*(part.to(fn(part).device) for part in self.parts)))
        self.missions = self.missions.to(fn(self.missions).device)
        return self

    def select_(self, index: Tensor) -> None:
        """Keep the missions in ``index``; what has no rows as yet stays as it is."""
        parts = (part[index] if part.dim() and len(part) else part for part in self.parts)
        self.keep(self.kind(*parts))

    def follow(self, missions: Tensor) -> bool:
        """Keep the rows of the missions that are left; return whether that could be done.

        Args:
            missions: their numbers ``(l)``, or () for a state that all share.

        Returns:
            False if these are not among the missions that were known so far: the owner then
            starts anew, for these.
        """
        known, before = self.missions, self._asked
        self._asked = missions, missions._version
        if before[0] is missions and before[1] == missions._version:
            return True  # the numbers are not read, which would wait for the device
        if missions.shape == known.shape and torch.equal(missions, known):
            return True
        among = bool(missions.dim() and known.dim() and torch.isin(missions, known).all())
        if among:
            self.select_((missions.unsqueeze(-1) == known).int().argmax(-1))
        self.missions = missions.clone()  # not the model's own tensor: it may change in place
        return among
