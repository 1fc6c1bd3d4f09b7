"""Where the memory of a correction lives, if the loop stands around a robot."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from afm_rl.transforms.loop import Shell


class MemoryHolder(Shell):
    """A view of the loop around a robot, or around a batch ``(*B)`` of them, whose memory it holds.

    As a simulator holds the state of its bodies: that of the newest step, and no other. A reset
    empties it, in the rows that begin; it is a part of the state dict, by which one goes back to a
    step. Views without a robot, policy and controller, are functions of a memory that their caller
    carries.
    """

    memory: Any = None
    """What is remembered up to the newest state, ``(*B, P)``; None before the first reset."""

    @property
    def learnt(self) -> Tensor | None:
        """The memory that episodes go on with, if a reset keeps it."""
        return self.memory if self.options["keep_memory_on_reset"] else None

    def hold(self, memory: Tensor, rows: Tensor | None = None) -> None:
        """Hold a memory ``(*B, P)`` from now on; only that of ``rows``, if given, which begin."""
        if rows is not None and self.memory is not None and self.memory.shape == memory.shape:
            rows = rows[(..., *[None] * (memory.dim() - rows.dim()))]  # for all agents
            memory = torch.where(rows, memory, self.memory)
        self.memory = memory
