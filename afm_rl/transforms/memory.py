"""Where the memory of a correction lives, if the loop stands around a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError
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


def check_state(place: str, given: Mapping[str, Any], own: Mapping[str, Any]) -> list[Tensor]:
    """Return the tensors of a state dict in the order of an own one, if they fit it.

    Raises:
        ConfigurationError: for other names or shapes, and for numbers that are not finite. Shapes
            of what is not known yet, None, are not compared.

    >>> check_state("wrapper", {"memory": torch.zeros(2)}, {"memory": torch.ones(2)})
    [tensor([0., 0.])]
    """
    if set(given) != set(own):
        raise ConfigurationError(
            f"{place}: state dict with {sorted(map(str, given))}: expected {sorted(own)}"
        )
    for name, expected in own.items():
        value = given[name]
        if not isinstance(value, Tensor) or not bool(value.isfinite().all()):
            raise ConfigurationError(f"{place}: {name} of the state dict: expected finite numbers")
        if expected is not None and value.shape != expected.shape:
            raise ConfigurationError(
                f"{place}: {name} of the state dict has the shape {tuple(value.shape)}: expected "
                f"{tuple(expected.shape)}, that of the same environments and model"
            )
    return [given[name] for name in own]
