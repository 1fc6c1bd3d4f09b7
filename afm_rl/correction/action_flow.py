"""Action flow matching: the core behind the contract of correctors, for any robot and model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from annotated_types import Le
from torch import Tensor
from torch.nn.functional import pad

from afm_rl.compiling.tracing import none_holds
from afm_rl.correction.achievable import Saturation
from afm_rl.correction.base import LONGEST, Correction, Corrector, Fields
from afm_rl.correction.belief import LEAST_NOISE, beliefs, gate
from afm_rl.correction.core import RegressionCore
from afm_rl.correction.pairs import gains_in_words
from afm_rl.correction.records import Measurement, Memory, Plan, Settings
from afm_rl.correction.table import RECENT_CHANGE, Hypothesis
from afm_rl.dynamics import DynamicsModel
from afm_rl.dynamics.inverse import UNSEEN, effective_action, only
from afm_rl.errors import ConfigurationError, check_number
from afm_rl.options import Count, Natural, NonNegative, Positive, Share, options
from afm_rl.spaces.small_matrices import add_diagonal, invert_positive

RECENT = 12  # newest transitions: a model that learns measures them again at every step
DISTANCE = 0.3  # unit of distance in the context coordinates, m
UNSEEN_SHARE, SEEN_SHARE = 0.02, 0.98  # of an actuator, between which the model sees a part of it
RANK = 1e-6  # squared singular value, against the largest, below which nothing is seen


class ActionFlow(Corrector):
    r"""Action flow matching: a Bayesian regression of the actuators over a table of hypotheses.

    In each tick (:meth:`correct`) the last transition gives a pair of command and effective action.
    Hypotheses that predicted it gain probability, and all are fitted to the pairs. Each hypothesis
    proposes a command, and the command with the least expected loss is executed. While *no fault*
    is believed, the planned action is executed, bit for bit. ``afm_rl/correction/README.md`` has
    the equations.

    Args:
        action_low: lowest action, ``(A,)``.
        action_high: highest action, ``(A,)``.
        hypotheses: rows of your own, in addition to the table's.

    Raises:
        ConfigurationError: for bounds, numbers or rows that cannot be used.

    >>> flow = ActionFlow(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> from afm_rl.dynamics import Dubins
    >>> memory, state = flow.begin(torch.zeros(3)), torch.zeros(3)
    >>> for _ in range(8):  # both motors are reversed
    ...     plan, bounds = torch.tensor([0.5, 0.2]), torch.tensor([[-1.0, -1.5], [1.0, 1.5]])
    ...     memory, correction = flow.correct(memory, plan, Dubins(), bounds)
    ...     state = Dubins()(state, -correction.executed_action)
    ...     memory = flow.observe(memory, state)
    >>> correction.executed_action.round(decimals=1)
    tensor([-0.5000, -0.2000])
    """

    cause: Tensor
    episodic = (*Corrector.episodic, "pending", "plans")

    @options("corrector")
    def __init__(
        self,
        action_low: Tensor,
        action_high: Tensor,
        delay: Annotated[
            Natural | Sequence[Natural], Le(LONGEST), "known delay in steps, of all axes or of each"
        ] = 0,
        home: Annotated[
            Sequence[float] | None, "neutral action, such as the pose of servos; None: zero"
        ] = None,
        context_coordinates: Annotated[
            Sequence[Natural], "state coordinates on which the fault may depend"
        ] = (),
        max_delay: Annotated[Natural, Le(25), "largest delay that is estimated, steps"] = 8,
        memory: Annotated[Count, "number of transitions in the memory"] = 80,
        nominal_log_odds: Annotated[NonNegative, Le(7), "prior log-odds of no fault"] = 1.0,
        discount: Annotated[Share, "decay of losses per step; 0.95: about 20 steps"] = 0.95,
        noise: Annotated[NonNegative, "initial noise, a share of the largest action"] = 0.05,
        noise_learning_rate: Annotated[
            Share, "share of the noise variance renewed in each step"
        ] = 0.1,
        innovation_gate: Annotated[
            NonNegative, "innovation below which the action passes through, std"
        ] = 1.0,
        student_t_dof: Annotated[Positive, "degrees of freedom of the Student-t residuals"] = 1.0,
        saturation: Saturation = "mixed",
        soft_start: Annotated[
            Share, "share of planned actions that is executed until an effect is seen; 1: all"
        ] = 1.0,
        hypotheses: Sequence[Hypothesis] = (),
    ) -> None:
        super().__init__(action_low, action_high, RECENT, delay, home)
        if not all(isinstance(row, Hypothesis) for row in hypotheses):
            raise ConfigurationError(
                f"corrector.hypotheses={hypotheses!r}: expected rows of your own, each a "
                "Hypothesis; names are gone, because the table is the same for all robots"
            )
        check_number("corrector.noise", noise, low=LEAST_NOISE)
        least = max(RECENT, max_delay + 1)
        if memory < least:
            raise ConfigurationError(
                f"corrector.memory={memory!r}: expected at least {least}, for delays of up to "
                f"{max_delay} steps"
            )
        settings = Settings(
            nominal_log_odds,
            discount,
            noise,
            noise_learning_rate,
            innovation_gate,
            student_t_dof,
            saturation,
        )
        self.context_coordinates, self.max_delay = list(context_coordinates), max_delay
        self.soft_start = soft_start
        sizes = self.action_size, memory, max_delay, self.delay, len(self.context_coordinates)
        self.core = RegressionCore(*sizes, settings, hypotheses)
        self.fields = {
            name: tuple(field.shape)
            for name, field in self.core.begin(torch.zeros(1))._asdict().items()
        }
        self.models = self.core.table.names
        of_rows = [
            _late(row.delay + self.delay) if row.delay else row.cause
            for row in self.core.table.hypotheses
        ]
        delays = [_late(d + self.delay) for d in range(1, max_delay + 1)]
        self.causes = tuple(dict.fromkeys([of_rows[0], *delays, *of_rows]))
        index = torch.tensor([self.causes.index(cause) for cause in of_rows])
        self.register_buffer("cause", index, persistent=False)

    def shapes(self, state_size: int) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of all fields of a memory; the core's come last."""
        awaited = {"awaited": (1,)} if self.soft_start < 1.0 else {}
        return {**super().shapes(state_size), **awaited, **self.fields}

    def begin(self, state: Tensor, model: DynamicsModel | None = None) -> Fields:
        """Return the memory of missions that begin in ``state`` ``(*B, S)``."""
        memory = super().begin(state, model)
        begun = {"noise": memory["noise"] + self.core.settings.noise}
        if "awaited" in memory:  # steps until the first action has acted, and the next one plans
            begun["awaited"] = memory["awaited"] + self.max_delay + self.delay + 2
        return memory | begun

    def resume(self, memory: Fields, state: Tensor, model: DynamicsModel | None = None) -> Fields:
        """Return the memory of missions that begin again in ``state`` ``(*B, S)``.

        As that of any corrector; and before the beginning there were neutral commands, whose
        effects are not known: those of the last mission do not act in this one.
        """
        memory, rest = super().resume(memory, state, model), self.core.newest
        begun = {
            name: pad(memory[name][..., rest:], (0, rest))
            for name in ("commands", "effects", "stds", "validity")
        }
        places = memory["contexts"]
        begun["contexts"] = torch.cat(
            [places[..., rest:], places[..., -1:].expand(*places.shape[:-1], rest)], -1
        )
        return memory | begun

    def answer(
        self, memory: Fields, planned: Tensor, model: DynamicsModel, bounds: Tensor, limits: Tensor
    ) -> tuple[Fields, Correction]:
        """Measure the last transition, let the core tick, and return to units of the action."""
        measured, measures = self.measure(memory, model)
        wanted, awaited = planned, Fields()
        if "awaited" in memory:
            wanted, awaited = self.softened(memory, planned, measured)
        plan = self.plan_of(memory, wanted, bounds, limits)
        with torch.inference_mode():
            core, step = self.core_in(memory).tick(self.core_of(memory), measured, plan)
        # What is not corrected is the plan, to the bit.
        executed = wanted.clamp(*bounds.unbind(-2))
        if limits is not bounds:
            executed = executed.clamp(*limits.unbind(-2))
        effect = executed
        if not none_holds(step.corrected):
            on = step.corrected.unsqueeze(-1)
            reach = torch.stack([step.effect_low, step.effect_high], -2)
            executed = torch.where(on, self.denormalise(step.command), executed)
            effect = torch.where(on, self.denormalise(step.effect), effect)
            bounds = torch.where(on[..., None], self.denormalise(reach), bounds)
        return core._asdict() | measures | awaited, Correction(
            planned_action=planned,
            executed_action=executed,
            predicted_effect=effect,
            effect_bounds=bounds,
            corrected=step.corrected.clone(),
            innovation=(measured.innovation * measured.validity[..., -1:]).squeeze(-1),
            noise=self.scale * core.noise,
        )

    def softened(
        self, fields: Fields, planned: Tensor, measured: Measurement
    ) -> tuple[Tensor, Fields]:
        """Return planned actions ``(*B, A)``, reduced while no action has had an effect.

        And for how many steps this may last. An effect is seen if the model explains it, or if it
        exceeds the noise and its uncertainty.
        """
        left, quiet = fields["awaited"], gate(self.core.settings, self.core_of(fields))
        effects, stds = measured.effects[..., -1], measured.stds[..., -1]
        beyond = (effects.abs() > torch.maximum(fields["noise"], 3 * stds)).any(-1, keepdim=True)
        explained = measured.innovation <= quiet
        seen = (measured.validity[..., -1:] > 0) & (beyond | explained)
        share = torch.where(left > 0, self.soft_start, 1.0)
        reduced = self.home + share * (planned - self.home)
        return reduced, {"awaited": torch.where(seen, 0.0, (left - 1).clamp_min(0))}

    def measure(self, memory: Fields, model: DynamicsModel) -> tuple[Measurement, Fields]:
        """Return the newest pair of memories ``(*B)``, and the derivative of a model that keeps it.

        If the model learns, all of the recent pairs.
        """
        names = ("states", "actions", "next_states", "valid")
        state, executed, reached, valid = (memory[name] for name in names)
        count = 1 if model.taught_in is None else valid.shape[-2]
        if count < valid.shape[-2]:
            parts = (state, executed, reached, valid)
            state, executed, reached, valid = (x[..., -count:, :] for x in parts)
        # What acted last was expected to have an effect; older ones were measured before.
        guess = memory["expected"].unsqueeze(-2)
        if count > 1:
            guess = torch.cat([memory["effects"][..., 1 - count :].mT, guess], -2)
        core, kept, derivative = self.core_of(memory), memory.get("derivative"), None
        if kept is not None:
            derivative = kept.unsqueeze(-3).expand(*kept.shape[:-2], count, -1, -1)
        quiet = gate(self.core.settings, core)
        seen = effective_action(
            model,
            state,
            executed,
            reached,
            self.scale,
            quiet=quiet,
            guess=self.denormalise(guess),
            derivative=derivative,
        )
        commands, innovation, std = self.normalise(executed).mT, seen.innovation[..., -1:], seen.std
        effects, hidden = commands, None  # the model sees all of every command
        if seen.action is not executed:
            effects = self.normalise(seen.action).mT
        in_part = seen_in_part(std[..., -1, :]) | (core.hidden != 0).any(-1)
        if not none_holds(in_part):
            surprising = (innovation > quiet) & in_part.any(-1, keepdim=True)
            newest, hidden = self._seen_std(core.hidden, model, state, executed, std, surprising)
            std = torch.cat([std[..., :-1, :], newest.unsqueeze(-2)], -2)
        contexts = self.context_of(state).mT if self.context_coordinates else core.contexts
        measured = Measurement(
            commands, effects, std.mT, valid.squeeze(-1), innovation, contexts, hidden
        )
        if kept is None or seen.derivative is None:
            return measured, {}
        return measured, {"derivative": seen.derivative[..., -1, :, :].to(kept)}

    def _seen_std(
        self,
        hidden: Tensor,
        model: DynamicsModel,
        state: Tensor,
        executed: Tensor,
        std: Tensor,
        surprising: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the newest std ``(*B, A)``, and what a model does not see of commands, I - P."""
        state, executed = state[..., -1, :], executed[..., -1, :]
        noise = model.noise_scale(state, executed)
        asked = only(surprising, executed, model)
        jacobian = model.jacobian(state, asked) * (self.scale / noise[..., None])
        return observed(hidden, jacobian.double(), std[..., -1, :], surprising)

    def plan_of(self, memory: Fields, planned: Tensor, bounds: Tensor, limits: Tensor) -> Plan:
        """Return a plan ``(*B, A)`` in the units of the core; bounds are ``(*B, 2, A)``."""
        low, high = least, most = self.normalise(bounds).unbind(-2)
        if limits is not bounds:
            least, most = self.normalise(limits).unbind(-2)
        queue = self.normalise(memory["queue"]).mT if self.delay else None
        context = self.context_of(memory["state"]) if self.context_coordinates else None
        return Plan(self.normalise(planned), low, high, least, most, queue, context)

    def context_of(self, state: Tensor) -> Tensor:
        """Return the coordinates ``(*B, G)`` on which the fault may depend."""
        return torch.stack([state[..., k] for k in self.context_coordinates], -1) / DISTANCE

    def core_in(self, memory: Fields) -> RegressionCore:
        """Return the core in the precision of a memory; its constants are the same in all."""
        core, dtype = self.core, memory["noise"].dtype
        return core if core.table.mean.dtype is dtype else core.to(dtype)

    def core_of(self, memory: Fields) -> Memory:
        """Return the core's fields of a memory."""
        return Memory(*map(memory.__getitem__, self.fields))

    def weights_in(self, memory: Fields) -> Tensor:
        """Return how probable the :attr:`models` are, by axis, ``(*B, H, A)``."""
        core = self.core_of(memory)
        return beliefs(self.core_in(memory).table, self.core.settings, core).mT

    def belief_in(self, memory: Fields) -> Tensor:
        """Return how probable the :attr:`causes` are, by axis, ``(*B, C, A)``.

        >>> flow = ActionFlow(-torch.ones(1), torch.ones(1))
        >>> belief = flow.belief_in(flow.begin(torch.zeros(2)))
        >>> flow.causes[0], belief[0].item() > 0.7, belief.sum(-2).round(decimals=4)
        ('no fault', True, tensor([1.]))
        """
        weights = self.weights_in(memory)
        none = weights.new_zeros(*weights.shape[:-2], len(self.causes), self.action_size)
        return none.scatter_add(-2, self.cause.unsqueeze(-1).expand_as(weights), weights)

    def cause_in(self, memory: Fields) -> str:
        """Return the likeliest change that memories ``(*B)`` show, in words."""
        belief = self.belief_in(memory).movedim(-2, -1).flatten(0, -2).mean(0)
        cause = self.causes[1 + int(belief[1:].argmax())]
        if cause == RECENT_CHANGE:
            names = ("commands", "effects", "stds")
            sent, came, std = (memory[name].mT.flatten(0, -2) for name in names)
            return gains_in_words(sent, came, std, memory["validity"].reshape(-1, 1))
        return cause + (": a delay that the model lacks?" if "late" in cause else "")

    def delay_in(self, memory: Fields) -> Tensor:
        """Return how many steps the next action needs until it acts, ``(*B)``."""
        steps = memory["delay"].squeeze(-1).long()
        return steps + self.delay if self.delay else steps

    def under_way(self, memory: Fields) -> Tensor:
        """Return the effects of the newest commands, the oldest first, ``(*B, K, A)``."""
        return self.denormalise(memory["pending"].mT[..., : self.max_delay + self.delay, :])

    def noise_in(self, memory: Fields) -> Tensor:
        """Return the noise that was learnt, ``(*B, A)``, in units of the action."""
        return self.scale * memory["noise"]

    def expected_in(self, memory: Fields) -> tuple[Tensor, Tensor]:
        """Return the effect that is expected now, and its standard deviation, ``(*B, A)``."""
        weights, forecasts = self.weights_in(memory).mT, memory["forecasts"]
        mean = (weights * forecasts).sum(-1)
        variance = (weights * (forecasts - mean.unsqueeze(-1)).square()).sum(-1)
        std = (variance + memory["noise"].square()).sqrt()
        return self.denormalise(mean), self.scale * std

    @torch.no_grad()
    def follow(self, memory: Fields, action: Tensor, model: DynamicsModel) -> Fields:
        """Return the memory if somebody else executes ``action`` ``(*B, A)`` now."""
        measured, measures = self.measure(memory, model)
        core = self.core_in(memory).observe(self.core_of(memory), measured)
        return self.executing(memory | core._asdict() | measures, action, action)

    def predict(
        self, memory: Fields, action: Tensor, model: DynamicsModel
    ) -> tuple[Tensor, Tensor]:
        """Return the effect that an action ``(*B, A)`` will have, and its standard deviation.

        Both in units of the action: what the model would have to be given, so that it expects what
        the robot will do. With a delay it is what acts now, of earlier commands.
        """
        return self.expected_in(self.follow(memory, action, model))

    @torch.no_grad()
    def executing(self, memory: Fields, planned: Tensor, executed: Tensor) -> Fields:
        """Return the memory if other actions ``(*B, A)`` are planned and executed now."""
        memory = super().executing(memory, planned, executed)
        bounds = self.denormalise(torch.stack([self.lowest, self.highest]))
        bounds = bounds.to(executed).expand(*executed.shape[:-1], 2, -1)
        plan = self.plan_of(memory, executed, bounds, bounds)
        foreseen = self.core_in(memory).predict_executed(self.core_of(memory), plan)
        names = ("forecasts", "expected", "pending")
        return memory | {name: getattr(foreseen, name) for name in names}

    def reported(self, memory: Fields, given: Tensor) -> Fields:
        """Return the memory with forecasts moved by what was given more than sent."""
        sent = memory["queue"][..., 0, :] if self.delay else memory["executed_action"]
        more = ((given - sent) / self.scale).unsqueeze(-1)
        return super().reported(memory, given) | {"forecasts": memory["forecasts"] + more}


def seen_in_part(std: Tensor) -> Tensor:
    """Return of which actuators a transition may show a part alone, ``(*B, A)``."""
    return (std > UNSEEN / 8) & (std < 0.99 * UNSEEN)


def observed(
    hidden: Tensor, jacobian: Tensor, std: Tensor, surprising: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return the standard deviations of what a model sees of an effect, and I - P.

    If a forecast's derivative J has less rank than there are actuators, only P v is known,

    .. math:: P = (J^\top J + \epsilon I)^{-1} J^\top J,

    and its standard deviation is smaller than v's.

    Args:
        hidden: I - P of the transition before, ``(*B, A, A)``, kept where nothing surprises.
        jacobian: J, normalised, at the command that acted, ``(*B, D, A)``.
        std: standard deviation of the effective action, ``(*B, A)``.
        surprising: does the innovation exceed the gate? ``(*B, 1)``.
    """
    square = jacobian.mT @ jacobian
    largest = square.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
    scaled = square / largest.clamp_min(1e-12)
    sees = invert_positive(add_diagonal(scaled, RANK)) @ scaled
    share = sees.diagonal(dim1=-2, dim2=-1)
    partly = (share > UNSEEN_SHARE) & (share < SEEN_SHARE)
    covariance = invert_positive(add_diagonal(square, UNSEEN**-2))
    variance, of_seen = (
        of.diagonal(dim1=-2, dim2=-1) for of in (covariance, sees @ covariance @ sees)
    )
    less = torch.where(surprising & partly, (of_seen / variance).sqrt(), 1.0).to(std)
    hides = (add_diagonal(-sees, 1.0) * partly[..., None]).to(hidden)
    return std * less, torch.where(surprising[..., None], hides, hidden)


def _late(steps: int) -> str:
    """Return a delay in words."""
    return f"{steps} step{'s' * (steps > 1)} late"
