"""Views of the loop: options as attributes, records as entries, and where the memory lives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from afm_rl.correction import Correction
from afm_rl.correction.base import Fields
from afm_rl.errors import ConfigurationError, warn
from afm_rl.transforms.loop import CorrectionLoop, chosen_rows
from afm_rl.transforms.loop_options import LoopOptions


def _option(name: str) -> property:
    def change(shell: Shell, value: Any) -> None:
        shell._loop = shell._loop.changed(**{name: value})  # type: ignore[misc]

    return property(lambda shell: shell._loop.options[name], change)


class Shell:
    """A view of the loop, whose options are attributes, some of which may be changed."""

    _loop: CorrectionLoop

    @property
    def loop(self) -> CorrectionLoop:
        """The loop of which this is a view."""
        return self._loop

    @property
    def options(self) -> LoopOptions:
        """The options of the loop, to be handed on."""
        return self._loop.options

    @property
    def residual(self) -> Any:
        """What is known of the fits, with ``residual_steps``: steps, explained, suspect, since.

        A :class:`~afm_rl.transforms.residual_steps.ResidualState`; None without, or before a reset.
        """
        return None if self._loop.residual is None else self._loop.residual.report


for _name in LoopOptions.__annotations__:
    setattr(Shell, _name, _option(_name))


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


def check_state(place: str, given: Mapping[str, Any], present: Mapping[str, Any]) -> Fields:
    """Return the tensors of a state dict by name, if they fit the present ones.

    Args:
        place: whose state it is, for messages.
        given: the state dict.
        present: the present state; None for what is not known yet: its shape is not compared.

    Raises:
        ConfigurationError: for other names or shapes, and for numbers that are not finite.

    >>> import torch
    >>> check_state("wrapper", {"over": torch.zeros(2)}, {"over": torch.ones(2)})
    {'over': tensor([0., 0.])}
    """
    check_version(place, given)
    if set(given) != set(present):
        unknown, lacking = sorted({*given} - {*present}), sorted({*present} - {*given})
        raise ConfigurationError(
            f"{place}: state dict: {unknown} are unknown, and {lacking} are missing; load one that "
            "was saved with the same environments, model and options"
        )
    for name, expected in present.items():
        value = given[name]
        if not isinstance(value, Tensor) or not bool(value.isfinite().all()):
            raise ConfigurationError(f"{place}: {name} of the state dict: expected finite numbers")
        if expected is not None and value.shape != expected.shape:
            raise ConfigurationError(
                f"{place}: {name} of the state dict has the shape {tuple(value.shape)}: expected "
                f"{tuple(expected.shape)}, that of the same environments and model"
            )
    return {name: given[name] for name in present}


def check_version(place: str, given: Mapping[str, Any], prefix: str = "") -> None:
    """Refuse a state dict of version 0.3, whose memory is one vector without names."""
    if {f"{prefix}memory", f"{prefix}_extra_state"} & {*given}:
        raise ConfigurationError(
            f"{place}: this state dict is of version 0.3, whose memory cannot be continued; begin "
            "with reset()"
        )


def entries_of(step: Correction) -> TensorDict:
    """Return the record of a step as the entries of a tensordict ``(*B)``."""
    fields = {name: field for name, field in step._asdict().items() if field is not None}
    return TensorDict(fields, step.corrected.shape, device=step.corrected.device)


def warn_of_old(tensordict: TensorDictBase, prefix: NestedKey) -> None:
    """Warn if a tensordict holds the entries of the next step already: it is an old one."""
    later = tensordict.get("next", None)
    if later is not None and later.get(prefix, None) is not None:
        warn(
            f"this step was made before: ('next', {prefix!r}) is in the tensordict, so its memory "
            "is an old one; continue with step_mdp(tensordict)"
        )
