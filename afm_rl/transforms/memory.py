"""Where the memory of a correction lives, if the loop stands around a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from afm_rl.correction.base import Fields
from afm_rl.errors import ConfigurationError
from afm_rl.transforms.loop import Shell, chosen_rows


class MemoryHolder(Shell):
    """A view of the loop around a robot, or around a batch ``(*B)`` of them, whose memory it holds.

    As a simulator holds the state of its bodies: that of the newest step, and no other. A reset
    empties it, in the rows that begin; it is a part of the state dict, by which one goes back to a
    step. Views without a robot, policy and controller, are functions of a memory that their caller
    carries.
    """

    memory: Any = None
    """Fields ``(*B, ...)`` by name, up to the newest state; None before the first reset."""

    @property
    def learnt(self) -> Fields | None:
        """The memory that episodes continue with, if a reset keeps it."""
        return self.memory if self.options["keep_memory_on_reset"] else None

    def hold(self, memory: Fields, rows: Tensor | None = None) -> None:
        """Hold a memory from now on; only that of ``rows``, if given, which begin."""
        before = self.memory
        if rows is not None and before is not None:
            if before["state"].shape == memory["state"].shape:
                memory = chosen_rows(rows, memory, before)  # of all agents
        self.memory = memory


def check_state(place: str, given: Mapping[str, Any], own: Mapping[str, Any]) -> Fields:
    """Return the tensors of a state dict by name, if they fit an own one.

    Args:
        place: whose state it is, for messages.
        given: the state dict.
        own: the present state; None for what is not known yet: its shape is not compared.

    Raises:
        ConfigurationError: for other names or shapes, and for numbers that are not finite.

    >>> import torch
    >>> check_state("wrapper", {"over": torch.zeros(2)}, {"over": torch.ones(2)})
    {'over': tensor([0., 0.])}
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
    return {name: given[name] for name in own}
