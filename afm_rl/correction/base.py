"""The contract between the transform and what corrects its actions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from annotated_types import Le
from torch import Tensor, nn

from afm_rl.compiling.tracing import same
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError
from afm_rl.faults import count_repeats, safe_action, trusted, whole
from afm_rl.options import Count, Natural, options

LONGEST = 1000  # steps that a known delay may have: a typing error rather than a robot

TRANSITION = ("states", "planned_actions", "actions", "next_states", "valid")

Fields = dict[str, Tensor]
"""What is remembered of missions ``(*B)``: fields ``(*B, ...)`` by name."""


class Correction(NamedTuple):
    """The record of a step: what was planned, what is executed instead, and what led to it.

    Its names are those of the entries of the transform and of ``info["afm"]`` of the wrappers,
    which add the ``delay`` until the next action acts; a recording has the names of the actions.
    Fields that nothing has filled in are None.
    """

    planned_action: Tensor
    """``(*B, A)``."""
    executed_action: Tensor
    """``(*B, A)``."""
    predicted_effect: Tensor
    """The effect that the executed action is predicted to have, ``(*B, A)``."""
    effect_bounds: Tensor
    """Lowest and highest effect that plans should keep to, ``(*B, 2, A)``; narrower or wider than
    the action bounds."""
    corrected: Tensor
    """Is the action corrected? Would it be, if that is disabled? ``(*B)``."""
    innovation: Tensor
    """Largest error of the newest transition, in standard deviations of the model, ``(*B)``."""
    noise: Tensor
    """Standard deviation of effects that no hypothesis explains, ``(*B, A)``."""
    enabled: Tensor | None = None
    """Is this mission corrected? ``(*B)``."""
    belief: Tensor | None = None
    """How probable the causes are, by axis, ``(*B, C, A)``, if it is requested."""
    fitted: Tensor | None = None
    """Was the model fitted to this robot? ``(*B)``, with ``residual_steps``."""

    def to(self, dtype: torch.dtype) -> Correction:
        """Return the record with its numbers in another type; flags stay as they are."""
        fields = self._asdict().items()
        numbers = {name: x for name, x in fields if x is not None and x.is_floating_point()}
        return self._replace(**{name: x.to(dtype) for name, x in numbers.items()})


class Corrector(nn.Module, ABC):
    """Turns planned actions into executed ones, given the transitions that it has seen.

    A corrector is a pure function of a memory, a dictionary of fields ``(*B, ...)``:
    :meth:`begin` makes it, :meth:`correct` turns a planned action into the one to execute, and
    :meth:`observe` adds the state that this led to. A subclass says in :meth:`answer` what to
    execute. Inside, an action is counted from ``home`` and divided by the largest action,
    u in [-1, 1]^A: so a gain on an action stays a gain, also where actions cannot be negative, as
    thrusts.

    Fields of every memory are:

    * the present ``state`` ``(*B, S)``, whether it is ``trusted``, and how often the same reading
      came before, ``repeats``, ``(*B, 1)``,
    * ``planned_action``, ``executed_action`` ``(*B, A)`` and ``corrected`` ``(*B, 1)``, of the last
      step,
    * the last R transitions, or one, if the model does not learn: ``states``, ``planned_actions``,
      ``actions``, ``next_states`` ``(*B, R, ...)`` and ``valid`` ``(*B, R, 1)``,
    * the ``queue`` ``(*B, D, A)`` of commands whose known delay has not passed; and for how many
      steps those from before a reset may still act, ``carryover`` ``(*B, 1)``,
    * the ``derivative`` ``(*B, D, A)``, of a model that keeps it.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        delay: known steps from an action to its effect, one number or one per axis. Faster axes
            wait for the slowest, so that the effects of one action come together.
        home: the neutral action, such as the pose of position servos, ``(A,)``; None: zero.

    Raises:
        ConfigurationError: for bounds or numbers that cannot be used.
    """

    scale: Tensor
    home: Tensor
    lowest: Tensor
    highest: Tensor
    hold: Tensor
    episodic: tuple[str, ...] = (
        "state",
        "planned_action",
        "executed_action",
        "trusted",
        "repeats",
        "queue",
        "derivative",
    )
    """Fields of a memory that belong to one episode; the others are what was learnt."""
    causes: tuple[str, ...] = ()
    """What may have happened to an actuator, in words; none if nothing is believed."""

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        recent: Annotated[Count, "transitions stored as observed, R"],
        delay: Annotated[Natural | Sequence[Natural], Le(LONGEST), "known delay in steps"] = 0,
        home: Annotated[
            Sequence[float] | None, "neutral action, such as the pose of servos; None: zero"
        ] = None,
    ) -> None:
        super().__init__()
        low, high = torch.as_tensor(action_low), torch.as_tensor(action_high)
        fits = low.shape == high.shape and low.dim() == 1 and len(low)
        if not fits or not bool(((low < high) & (high - low).isfinite()).all()):
            raise ConfigurationError(
                f"corrector: action bounds {low.tolist()}, {high.tolist()}: expected two lists of "
                "one size, finite, low < high"
            )
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
        self.action_size, self.has_home = len(scale), bool(rest.any())
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
        """Return names and shapes of the fields of a memory; subclasses add theirs."""
        size, recent = self.action_size, self.recent
        return {
            "state": (state_size,),
            "planned_action": (size,),
            "executed_action": (size,),
            "corrected": (1,),
            "trusted": (1,),
            "repeats": (1,),
            "carryover": (1,),
            "states": (recent, state_size),
            "planned_actions": (recent, size),
            "actions": (recent, size),
            "next_states": (recent, state_size),
            "valid": (recent, 1),
            "queue": (self.delay, size),
        }

    def begin(self, state: Tensor, model: DynamicsModel | None = None) -> Fields:
        """Return the memory ``(*B)`` of missions that begin in ``state`` ``(*B, S)``.

        Args:
            state: the first one.
            model: whose derivatives are remembered, if it keeps them.
        """
        shapes, batch = self.shapes(state.shape[-1]), state.shape[:-1]
        if model is not None and model.keeps_derivative:
            shapes["derivative"] = (model.manifold.tangent_size, self.action_size)
        if model is not None and model.taught_in is None:
            shapes |= {name: (1, *shapes[name][1:]) for name in TRANSITION}
        fields = {name: state.new_zeros(*batch, *shape) for name, shape in shapes.items()}
        rest = self.denormalise(torch.zeros_like(self.lowest).clamp(self.lowest, self.highest))
        return fields | {
            "state": state.clone(),
            "trusted": whole(state).unsqueeze(-1).to(state),
            "actions": fields["actions"] + rest.to(state),
            "queue": fields["queue"] + rest.to(state),
        }

    def resume(self, memory: Fields, state: Tensor, model: DynamicsModel | None = None) -> Fields:
        """Return the memory of missions that begin again in ``state`` ``(*B, S)``.

        What was learnt is kept. The state, the actions of the last step and commands under way are
        those of a beginning, so that no transition leads from one episode into the next, and while
        commands of the last one may still act, transitions do not count. The newest one is that of
        a beginning, too, because others may have moved the robot in it.
        """
        begun, late = self.begin(state.to(memory["state"]), model), self.delay_in(memory)
        kept = {name: memory[name] for name in begun if name not in self.episodic}
        for name in TRANSITION:
            kept[name] = torch.cat([kept[name][..., :-1, :], begun[name][..., -1:, :]], -2)
        return begun | kept | {"carryover": late.unsqueeze(-1).to(begun["state"])}

    def observe(self, memory: Fields, next_state: Tensor) -> Fields:
        """Return the memory with the transition to ``next_state`` ``(*B, S)``.

        A transition with a faulty or stale reading at either end does not count.
        """
        state, next_state = memory["state"], next_state.clone()  # others may change theirs
        repeats = count_repeats(next_state, state, memory["repeats"])
        sound = trusted(next_state, repeats).to(state)
        valid = sound * memory["trusted"] * (memory["carryover"] == 0)
        acted, queue = memory["executed_action"], memory["queue"]
        if self.delay:
            queue = torch.cat([queue, acted.unsqueeze(-2)], -2)
            acted, queue = queue[..., 0, :], queue[..., 1:, :]
        ends = (state, memory["planned_action"], acted, next_state, valid)
        fields = {name: end.unsqueeze(-2) for name, end in zip(TRANSITION, ends, strict=True)}
        if memory["valid"].shape[-2] > 1:
            fields = {
                name: torch.cat([memory[name][..., 1:, :], newest], -2)
                for name, newest in fields.items()
            }
        return (
            memory
            | fields
            | {
                "state": next_state,
                "queue": queue,
                "trusted": sound,
                "repeats": repeats,
                "carryover": (memory["carryover"] - 1).clamp_min(0),
            }
        )

    @torch.no_grad()
    def correct(
        self,
        memory: Fields,
        planned: Tensor,
        model: DynamicsModel,
        bounds: Tensor,
        limits: Tensor | None = None,
    ) -> tuple[Fields, Correction]:
        """Return the next memory, and what to execute for a planned action ``(*B, A)``.

        Args:
            memory: up to the present state.
            planned: the planner's action.
            model: the dynamics model as it is now.
            bounds: lowest and highest action, ``(*B, 2, A)``.
            limits: between which the executed action must be, whatever would be best, likewise;
                None: the bounds.
        """
        limits = bounds if limits is None else limits
        fields, correction = self.answer(memory, planned, model, bounds, limits)
        (low, high), answer = limits.unbind(-2), correction.executed_action
        executed = answer.clamp(low, high)
        if not same(executed, answer):  # beyond the limits, or not finite
            executed, _ = safe_action(answer, low, high, memory["executed_action"])
        note = {
            "planned_action": planned,
            "executed_action": executed,
            "corrected": correction.corrected.unsqueeze(-1).to(executed),
        }
        return memory | fields | note, correction._replace(executed_action=executed)

    @abstractmethod
    def answer(
        self,
        memory: Fields,
        planned: Tensor,
        model: DynamicsModel,
        bounds: Tensor,
        limits: Tensor,
    ) -> tuple[Fields, Correction]:
        """Return the fields of the memory that change, and what to execute for a planned action.

        Arguments are those of :meth:`correct`, which notes the actions in the memory, and keeps the
        executed one within the limits.
        """

    def belief_in(self, memory: Fields) -> Tensor:
        """Return how probable the :attr:`causes` are, by axis, ``(*B, C, A)``; none by default."""
        state = memory["state"]
        return state.new_zeros(*state.shape[:-1], len(self.causes), self.action_size)

    def cause_in(self, memory: Fields) -> str:
        """Return in words what memories ``(*B)`` show of the actuators; empty by default."""
        return ""

    def delay_in(self, memory: Fields) -> Tensor:
        """Return how many steps the next action needs until it acts, ``(*B)``."""
        state = memory["state"]
        return state.new_full(state.shape[:-1], self.delay, dtype=torch.long)

    def under_way(self, memory: Fields) -> Tensor:
        """Return the effects of the newest commands, the oldest first, ``(*B, K, A)``.

        Of these :meth:`delay_in` are to come.
        """
        return memory["queue"]

    def executing(self, memory: Fields, planned: Tensor, executed: Tensor) -> Fields:
        """Return the memory if other actions ``(*B, A)`` are planned and executed now."""
        return memory | {"planned_action": planned, "executed_action": executed}

    def reported(self, memory: Fields, given: Tensor) -> Fields:
        """Return the memory if actuators gave ``given`` ``(*B, A)`` of what they were sent."""
        if not self.delay:
            return memory | {"executed_action": given.clone()}
        queue = torch.cat([given.unsqueeze(-2), memory["queue"][..., 1:, :]], -2)
        return memory | {"queue": queue}

    def sending(self, memory: Fields, executed: Tensor) -> Tensor:
        """Return what is sent now if ``executed`` ``(*B, A)`` is to act when all axes can.

        Itself, but on axes that are known to be faster than others.
        """
        if not self.holds:
            return executed
        every = torch.cat([memory["queue"], executed.unsqueeze(-2)], -2)
        which = (self.delay - self.hold).expand_as(executed).unsqueeze(-2)
        return every.gather(-2, which).squeeze(-2)

    def at_once(self, memory: Fields, executed: Tensor) -> Fields:
        """Return the memory if no axis waits for others with what is executed now, ``(*B, A)``."""
        if not self.holds:
            return memory
        executed = executed.unsqueeze(-2)
        which = (self.delay - self.hold).expand_as(executed)
        every = torch.cat([memory["queue"], executed], -2).scatter(-2, which, executed)
        return memory | {"queue": every[..., :-1, :]}

    def unchanged(self, planned: Tensor, innovation: Tensor, bounds: Tensor) -> Correction:
        """Return the correction that executes what was planned."""
        nothing = innovation > torch.inf
        silence = torch.zeros_like(planned)
        return Correction(planned, planned, planned, bounds, nothing, innovation, silence)

    def normalise(self, action: Tensor) -> Tensor:
        """Return u for an action in its own units."""
        return (action - self.home if self.has_home else action) / self.scale

    def denormalise(self, unit: Tensor) -> Tensor:
        """Return the action for u."""
        return self.home + self.scale * unit if self.has_home else self.scale * unit
