"""Tensors of missions that end one after the other."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor, nn


class Kept(nn.Module):
    """A named tuple of tensors ``(l, ...)`` as buffers, so that checkpoints of missions hold it.

    The buffers are not persistent: they belong to missions, not to a stored model.

    >>> import torch
    >>> from afm_rl.learning.shape_search import Rows
    >>> kept = Kept(Rows(*torch.ones(3, 4, 7, 2)))
    >>> kept.select_(torch.tensor([2, 0]))
    >>> kept.parts.weight.shape
    torch.Size([2, 7, 2])
    """

    def __init__(self, parts: NamedTuple) -> None:
        super().__init__()
        self.kind: Any = type(parts)
        self.keep(parts)

    @property
    def parts(self) -> Any:
        """What is kept."""
        return self.kind(*(self.get_buffer(name) for name in self.kind._fields))

    def keep(self, parts: Any) -> None:
        """Replace it."""
        for name, part in zip(self.kind._fields, parts, strict=True):
            self.register_buffer(name, part, persistent=False)

    def select_(self, index: Tensor) -> None:
        """Keep the missions in ``index``."""
        self.keep(self.kind(*(part[index] for part in self.parts)))
