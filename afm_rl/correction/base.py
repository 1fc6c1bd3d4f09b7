"""The contract between the transform and what corrects its actions."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from annotated_types import Le
from torch import Tensor, nn

from afm_rl.correction.first_steps import CORRECTED, HELD_BACK, StepWarning
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError
from afm_rl.faults import count_repeats, trusted
from afm_rl.options import Count, Natural, options

LONGEST = 1000  # steps that a known delay may have: a typing error rather than a robot

Fields = dict[str, Tensor]
"""The fields of a memory, by name."""


class Layout(NamedTuple):
    """How the fields of a memory lie in one flat tensor.

    >>> layout = Layout.of({"pairs": (2, 3), "noise": (3,)})
    >>> fields = layout.unpack(torch.zeros(5, 9))
    >>> fields["pairs"].shape, layout.pack(fields).shape
    (torch.Size([5, 2, 3]), torch.Size([5, 9]))
    """

    names: list[str]
    """Of the fields, in their order."""
    sizes: list[int]
    """How many numbers each has."""
    shapes: list[tuple[int, ...]]
    """Their shapes, without those of a batch."""

    @classmethod
    def of(cls, shapes: dict[str, tuple[int, ...]]) -> Layout:
        """Return the layout of fields with these names and shapes."""
        return cls([*shapes], [math.prod(shape) for shape in shapes.values()], [*shapes.values()])

    def unpack(self, memory: Tensor) -> Fields:
        """Return the fields ``(*B, ...)`` of a memory ``(*B, P)``."""
        fields = zip(self.names, memory.split(self.sizes, -1), self.shapes, strict=True)
        return {
            name: field if len(shape) == 1 else field.unflatten(-1, shape)
            for name, field, shape in fields
        }

    def pack(self, fields: Fields) -> Tensor:
        """Return the memory ``(*B, P)`` that consists of fields ``(*B, ...)``."""
        each = zip((fields[name] for name in self.names), self.shapes, strict=True)
        flat = [field if len(shape) == 1 else field.flatten(-len(shape)) for field, shape in each]
        return torch.cat(flat, -1)


class Correction(NamedTuple):
    """What to execute instead of a planned action."""

    executed: Tensor
    """The action, ``(*B, A)``."""
    predicted: Tensor
    """The effect that it is predicted to have, ``(*B, A)``."""
    bounds: Tensor
    """Lowest and highest effect that an action can have, ``(*B, 2, A)``."""
    innovation: Tensor
    """Largest error of the newest transition, in standard deviations that the model states,
    ``(*B)``."""
    misaligned: Tensor
    """Is the action corrected? ``(*B)``."""
    noise: Tensor
    """Standard deviation of effects that nothing explains, ``(*B, A)``."""


class Corrector(nn.Module, ABC):
    """Turns planned actions into executed ones, given the transitions that it has seen.

    A corrector is a pure function on a memory, one flat tensor ``(*B, P)`` per mission:
    :meth:`begin` makes it, :meth:`correct` turns a planned action into the one to execute, and
    :meth:`observe` adds the state that this led to. Inside, an action is counted from the one at
    rest, ``home``, and divided by the largest one that its box has, u in [-1, 1]^A: a factor on an
    action stays one, also where it cannot be negative, as a thrust.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        delay: steps from an action to its effect that are known, one number or one per axis. Faster
            axes are kept waiting for the slowest, so that actions have their effects together.
        home: the action at rest, such as the pose of position servos, ``(A,)``; None: zero.

    Raises:
        ConfigurationError: for bounds or numbers that cannot be used.
    """

    scale: Tensor
    home: Tensor
    lowest: Tensor
    highest: Tensor
    hold: Tensor
    episodic: tuple[str, ...] = ("state", "planned", "executed", "repeats", "sent")
    """Parts of a memory that belong to one episode; the others are what was learnt."""
    causes: tuple[str, ...] = ()
    """What may have happened to an actuator, in words; none if nothing is believed."""

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        recent: Annotated[Count, "transitions that are kept as they were observed, R"],
        delay: Annotated[Natural | Sequence[Natural], Le(LONGEST), "known steps to its effect"] = 0,
        home: Annotated[Sequence[float] | None, "action at rest, as a pose; None: zero"] = None,
    ) -> None:
        super().__init__()
        low, high = torch.as_tensor(action_low), torch.as_tensor(action_high)
        fits = low.shape == high.shape and low.dim() == 1 and len(low)
        if not fits or not bool(((low < high) & (high - low).isfinite()).all()):
            raise ConfigurationError(
                f"corrector: action bounds {low.tolist()}, {high.tolist()}: expected two lists of "
                "one size, finite, low < high"
            )
        self.layouts: dict[int, Layout] = {}  # by the size of a state
        self.first_steps = StepWarning(CORRECTED)
        self.held_back = StepWarning(HELD_BACK, again=True)
        self.recent = recent
        rest = torch.zeros_like(low) if home is None else torch.as_tensor(home).to(low)
        if rest.shape != low.shape or not bool(
            ((low <= rest) & (rest <= high) | (rest == 0)).all()
        ):
            raise ConfigurationError(
                f"corrector.home={rest.tolist()}: expected {len(low)} actions between "
                f"{low.tolist()} and {high.tolist()}"
            )
        low, high = low - rest, high - rest
        scale = torch.maximum(low.abs(), high.abs())
        self.action_size = len(scale)
        ends = {"scale": scale, "home": rest, "lowest": low / scale, "highest": high / scale}
        for name, value in ends.items():
            self.register_buffer(name, value, persistent=False)
        steps = [delay] * self.action_size if isinstance(delay, int) else list(delay)
        if len(steps) != self.action_size:
            raise ConfigurationError(
                f"corrector.delay={delay!r}: expected one number of steps, or {self.action_size}"
            )
        self.delay, self.holds = max(steps), min(steps) < max(steps)
        self.register_buffer("hold", self.delay - torch.tensor(steps), persistent=False)

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of the parts of a memory; subclasses add theirs."""
        size = self.action_size
        return {
            "state": (state_size,),
            "planned": (size,),
            "executed": (size,),
            "misaligned": (1,),
            "repeats": (1,),
            "carryover": (1,),
            "transitions": (self.recent, 2 * state_size + 2 * size + 1),
            "sent": (self.delay, size),
        }

    def memory_size(self, state_size: int) -> int:
        """Return how many numbers a memory has, P."""
        return sum(self.layout(state_size).sizes)

    def states_in(self, memory: Tensor) -> int:
        """Return how many numbers a state has in a memory ``(*B, P)``."""
        none, one = self.memory_size(0), self.memory_size(1)
        return (memory.shape[-1] - none) // (one - none)

    def begin(self, state: Tensor) -> Tensor:
        """Return the memory ``(*B, P)`` of missions that begin in ``state`` ``(*B, S)``."""
        size = self.memory_size(state.shape[-1]) - state.shape[-1]
        memory = torch.cat([state, state.new_zeros(*state.shape[:-1], size)], -1)
        parts = self.unpack(memory, state.shape[-1])
        rest = self.denormalise(torch.zeros_like(self.lowest).clamp(self.lowest, self.highest))
        return self.pack({**parts, "sent": rest.to(memory).expand_as(parts["sent"])})

    def resume(self, memory: Tensor, state: Tensor) -> Tensor:
        """Return the memory ``(*B, P)`` of missions that begin again in ``state`` ``(*B, S)``.

        What was learnt is kept. The state, the actions of the last step and commands under way are
        those of a beginning, so that no transition leads from one episode into the next, and while
        commands of the last one may still act, transitions do not count.
        """
        parts, late = self.unpack(memory, state.shape[-1]), self.under_way(memory)[2]
        begun = self.unpack(self.begin(state.to(memory)), state.shape[-1])
        parts |= {name: begun[name] for name in self.episodic}
        return self.pack({**parts, "carryover": late.unsqueeze(-1).to(memory)})

    def observe(self, memory: Tensor, next_state: Tensor) -> Tensor:
        """Return the memory with the transition to ``next_state`` ``(*B, S)``.

        A transition with a faulty or stale reading at either end does not count.
        """
        parts = self.unpack(memory, next_state.shape[-1])
        state, count = parts["state"], parts["repeats"].squeeze(-1)
        after = count_repeats(next_state, state, count)
        valid = trusted(state, count) & trusted(next_state, after)
        valid &= parts["carryover"].squeeze(-1) == 0
        parts["carryover"] = (parts["carryover"] - 1).clamp_min(0)
        sent = torch.cat([parts["sent"], parts["executed"].unsqueeze(-2)], -2)
        acted, parts["sent"] = sent[..., 0, :], sent[..., 1:, :]
        ends = [state, parts["planned"], acted, next_state, valid.unsqueeze(-1)]
        row = torch.cat(ends, -1).unsqueeze(-2)
        parts["repeats"] = after.unsqueeze(-1)
        parts["transitions"] = torch.cat([parts["transitions"][..., 1:, :], row], -2)
        parts["state"] = next_state
        return self.pack(parts)

    @abstractmethod
    def correct(
        self,
        memory: Tensor,
        planned: Tensor,
        model: DynamicsModel,
        box: Tensor,
        limits: Tensor | None = None,
    ) -> tuple[Tensor, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``.

        Args:
            memory: up to the present state, ``(*B, P)``.
            planned: the planner's action.
            model: the dynamics model as it is now.
            box: lowest and highest action, ``(*B, 2, A)``.
            limits: between which the executed action must be, whatever would be best, likewise;
                None: the box. It is given where the loop has limits.
        """

    def belief_in(self, memory: Tensor) -> Tensor:
        """Return how probable the :attr:`causes` are, by axis, ``(*B, C, A)``; none by default."""
        return memory.new_zeros(*memory.shape[:-1], len(self.causes), self.action_size)

    def cause_in(self, memory: Tensor) -> str:
        """Return in words what memories ``(*B, P)`` show of the actuators; empty by default."""
        return ""

    def latest(self, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the present state, and the actions planned and executed last."""
        size, first = self.action_size, self.states_in(memory)
        state, planned, executed, _ = memory.tensor_split(
            [first, first + size, first + 2 * size], -1
        )
        return state, planned, executed

    def under_way(self, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state, the newest commands' effects, and how many of them are to come.

        Returns:
            ``(*B, S)``; ``(*B, K, A)``, in units of the action, the oldest first; ``(*B)``.
        """
        parts = self.unpack(memory, self.states_in(memory))
        late = torch.full_like(parts["state"][..., 0], self.delay, dtype=torch.long)
        return parts["state"], parts["sent"], late

    def executing(
        self,
        memory: Tensor,
        planned: Tensor,
        executed: Tensor,
        misaligned: Tensor | None = None,
    ) -> Tensor:
        """Return the memory with the actions that are planned and executed now, ``(*B, A)``.

        Also if another action is executed than :meth:`correct` returned.

        Args:
            memory: ``(*B, P)``.
            planned: the planner's action.
            executed: what is executed instead.
            misaligned: is it corrected? ``(*B)``; None: as it was noted.
        """
        state, _, _ = self.latest(memory)
        parts, first = [state, planned, executed], state.shape[-1] + 2 * self.action_size
        if misaligned is not None:
            parts.append(misaligned.unsqueeze(-1).to(memory))
            first += 1
        return torch.cat([*parts, memory[..., first:]], -1)

    def reported(self, memory: Tensor, given: Tensor) -> Tensor:
        """Return the memory if actuators gave ``given`` ``(*B, A)`` of what they were sent."""
        _, planned, _ = self.latest(memory)
        if not self.delay:
            return Corrector.executing(self, memory, planned, given)
        parts = self.unpack(memory, self.states_in(memory))
        sent = torch.cat([given.unsqueeze(-2), parts["sent"][..., 1:, :]], -2)
        return self.pack({**parts, "sent": sent})

    def sending(self, memory: Tensor, executed: Tensor) -> Tensor:
        """Return what is sent now if ``executed`` ``(*B, A)`` is to act when all axes can.

        Itself, but on axes that are known to be faster than others.
        """
        if not self.holds:
            return executed
        waiting = self.unpack(memory, self.states_in(memory))["sent"]
        every = torch.cat([waiting, executed.unsqueeze(-2)], -2)
        which = (self.delay - self.hold).expand_as(executed).unsqueeze(-2)
        return every.gather(-2, which).squeeze(-2)

    def at_once(self, memory: Tensor, executed: Tensor) -> Tensor:
        """Return the memory if no axis waits for others with what is executed now, ``(*B, A)``."""
        if not self.holds:
            return memory
        parts, executed = self.unpack(memory, self.states_in(memory)), executed.unsqueeze(-2)
        which = (self.delay - self.hold).expand_as(executed)
        every = torch.cat([parts["sent"], executed], -2).scatter(-2, which, executed)
        return self.pack({**parts, "sent": every[..., :-1, :]})

    def unpack(self, memory: Tensor, state_size: int) -> Fields:
        """Return the parts of a memory."""
        return self.layout(state_size).unpack(memory)

    def pack(self, parts: Fields) -> Tensor:
        """Return the memory that consists of parts, in the order of :meth:`shapes`."""
        return self.layout(parts["state"].shape[-1]).pack(parts)

    def layout(self, state_size: int) -> Layout:
        """Return how the parts of a memory lie in it, found once."""
        if state_size not in self.layouts:
            self.layouts[state_size] = Layout.of(self.shapes(state_size))
        return self.layouts[state_size]

    def split_transitions(self, rows: Tensor, state_size: int) -> tuple[Tensor, ...]:
        """Return state, planned, executed, next state and validity of rows of transitions."""
        size = self.action_size
        return rows.split([state_size, size, size, state_size, 1], -1)

    def unchanged(self, planned: Tensor, innovation: Tensor, box: Tensor) -> Correction:
        """Return the correction that executes what was planned."""
        nothing = innovation > torch.inf
        return Correction(planned, planned, box, innovation, nothing, torch.zeros_like(planned))

    def normalise(self, action: Tensor) -> Tensor:
        """Return u for an action in its own units."""
        return (action - self.home) / self.scale

    def denormalise(self, unit: Tensor) -> Tensor:
        """Return the action for u."""
        return self.home + self.scale * unit
