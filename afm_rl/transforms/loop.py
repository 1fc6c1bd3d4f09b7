"""The loop around a corrector: begin, act, observe; transform, policy and wrappers are views."""

from __future__ import annotations

from copy import copy
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from afm_rl.compiling.tracing import all_hold, may_look, none_holds
from afm_rl.correction import ActionFlow, Correction, Corrector
from afm_rl.correction.base import Fields
from afm_rl.correction.first_steps import CORRECTED, HELD_BACK, StepWarning
from afm_rl.dynamics import DynamicsModel, UnknownDynamics
from afm_rl.dynamics.predictions import check_predictions
from afm_rl.errors import ConfigurationError, check_instance, warn
from afm_rl.faults import check_numbers, finite
from afm_rl.options import filled
from afm_rl.transforms.actions import (
    bounds_of,
    check_precision,
    limits_of,
    precise,
    sanitised,
    stacked,
)
from afm_rl.transforms.delay_compensation import state_at_arrival
from afm_rl.transforms.loop_options import LoopOptions

LEAST_STEPS = 50  # to which a model is fitted


class CorrectionLoop:
    r"""Begin, act, observe: the correction of one environment or of a batch ``(*B)`` of them.

    Each step is a pure function of the memory, a dictionary of fields ``(*B, ...)``, which belongs
    to the caller, as do action spec and state. While the model explains the transitions, the
    planned action is executed; otherwise the corrector's answer (paper, section IV-C). The loop
    never learns and never changes the model. The record of a step is a
    :class:`~afm_rl.correction.Correction`.

    Args:
        owner: whose options these are, for messages.
        model: dynamics model, shared with planner and updater; None: given to :meth:`complete`.
        corrector: the correction, owned; None: an
            :class:`~afm_rl.correction.ActionFlow` for the action bounds.
        options: those of :class:`~afm_rl.transforms.loop_options.LoopOptions`, by name.

    Raises:
        ConfigurationError: for options that cannot be used, or parts that do not fit each other.

    >>> from torchrl.data import Bounded
    >>> from afm_rl.dynamics import Dubins
    >>> spec = Bounded(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> loop, state = CorrectionLoop("example").complete(Dubins(), spec), torch.zeros(3)
    >>> memory, _ = loop.begin(state, spec)
    >>> for _ in range(8):  # both motors are reversed
    ...     memory, step = loop.act(memory, torch.tensor([0.5, 0.2]), spec)
    ...     state = Dubins()(state, -step.executed_action)
    ...     memory = loop.observe(memory, state)
    >>> step.executed_action.round(decimals=1)
    tensor([-0.5000, -0.2000])
    """

    def __init__(
        self,
        owner: str,
        model: Any = None,
        corrector: Any = None,
        **options: Unpack[LoopOptions],
    ) -> None:
        self.owner, self.model, self.corrector = owner, model, corrector
        self.options: LoopOptions = filled(LoopOptions, owner, options)
        self.residual: Any = None
        self.first_steps = StepWarning(CORRECTED)
        self.held_back = StepWarning(HELD_BACK, again=True)
        self._checked = self._warned = False
        self._check_options()

    def _check_options(self) -> None:
        """Check what depends on more than one number; open the record."""
        steps, record = self.options["residual_steps"], self.options["record"]
        if 0 < steps < LEAST_STEPS:
            raise ConfigurationError(
                f"{self.owner}.residual_steps={steps}: expected 0, or at least {LEAST_STEPS} steps"
            )
        if isinstance(record, str | Path):
            from afm_rl.transforms.record import Recorder

            self.options["record"] = Recorder(record)
        elif record is not None and not hasattr(record, "acted"):
            raise ConfigurationError(
                f"{self.owner}.record={record!r}: expected a new file NAME.csv"
            )

    def changed(self, **options: Unpack[LoopOptions]) -> CorrectionLoop:
        """Return the same loop with other options."""
        loop = copy(self)
        loop.options = filled(LoopOptions, self.owner, self.options | options)
        loop._check_options()
        return loop

    def complete(
        self, model: DynamicsModel | None = None, action_spec: TensorSpec | None = None
    ) -> CorrectionLoop:
        """Return the loop with a model, and with an ActionFlow if there is no corrector.

        Args:
            model: the one that it has if None.
            action_spec: actions that can be executed, for which the corrector is made.

        Raises:
            ConfigurationError: for parts that do not fit each other.
        """
        check_precision()
        owner, corrector, delay = self.owner, self.corrector, self.options["delay"]
        model = check_instance(f"{owner}.model", model or self.model, DynamicsModel)
        size = model.action_size
        if corrector is None:
            low, high = bounds_of(action_spec)
            if low.shape[-1] != size or not bool((high - low).isfinite().all()):
                raise ConfigurationError(
                    f"{owner}: actions between {low.tolist()} and {high.tolist()}: expected the "
                    f"{size} finite bounds of the dynamics model's actions; limit the action spec, "
                    "or give a corrector with bounds of its own"
                )
            low, high = low.reshape(-1, size)[0], high.reshape(-1, size)[0]
            home = None if model.home is None else model.home.tolist()
            corrector = ActionFlow(low, high, delay=delay or 0, home=home)
        elif delay is not None:
            raise ConfigurationError(
                f"{owner}.delay={delay!r}: a corrector was given too; say it there, as in "
                f"ActionFlow(low, high, delay={delay!r})"
            )
        check_instance(f"{owner}.corrector", corrector, Corrector)
        if corrector.action_size != size:
            raise ConfigurationError(
                f"{owner}.corrector: made for {corrector.action_size} actions, but the dynamics "
                f"model has {size}"
            )
        for name in ("max_correction", "max_correction_rate"):
            limit = self.options[name]
            if isinstance(limit, list) and len(limit) != size:
                raise ConfigurationError(
                    f"{owner}.{name}={limit}: expected one number, or {size}, one per action"
                )
        if self.options["belief"] and not corrector.causes:
            raise ConfigurationError(
                f"{owner}.belief=True: {owner}.corrector={type(corrector).__name__} has no "
                "causes to believe in: give an ActionFlow, or leave belief out"
            )
        loop = copy(self)
        loop.model, loop.corrector = model, corrector
        if (steps := self.options["residual_steps"]) and loop.residual is None:
            from afm_rl.transforms.residual_steps import ResidualSteps

            loop.residual = ResidualSteps.of(owner, model, steps, corrector)
            loop.model = loop.residual.model
        return loop

    def spec(self, batch: torch.Size, dtype: torch.dtype, memory: torch.dtype) -> Composite:
        """Return the specs of the record of a step, for the types of actions and memory."""
        size, flag = self.corrector.action_size, Binary(shape=batch, dtype=torch.bool)
        names = ("planned_action", "executed_action", "predicted_effect", "noise")
        spec = {name: Unbounded((*batch, size), dtype=dtype) for name in names}
        spec["effect_bounds"] = Unbounded((*batch, 2, size), dtype=dtype)
        spec["innovation"] = Unbounded(batch, dtype=dtype)
        spec |= {"enabled": flag.clone(), "corrected": flag.clone()}
        if self.residual is not None:
            spec["fitted"] = flag
        if self.options["belief"]:
            causes = len(self.corrector.causes)
            spec["belief"] = Unbounded((*batch, causes, size), dtype=memory)
        return Composite(spec, shape=batch)

    @torch.no_grad()
    def begin(
        self, state: Tensor, action_spec: TensorSpec, learnt: Fields | None = None
    ) -> tuple[Fields, Correction]:
        """Return memory and record of missions that begin in ``state`` ``(*B, S)``.

        With what was learnt in a memory, if one is given.
        """
        check_precision()
        corrector, state = self.corrector, state.to(precise(state.dtype))
        self._check_model(state, action_spec)
        if self.residual is not None:
            self.residual.begin(state)
        if learnt is None or learnt["state"].shape[:-1] != state.shape[:-1]:
            memory = corrector.begin(state, self.model)
        else:
            learnt = {name: field.to(state) for name, field in learnt.items()}
            memory = corrector.resume(learnt, state, self.model)
        still = state.new_zeros(*state.shape[:-1], corrector.action_size, dtype=action_spec.dtype)
        bounds = stacked(bounds_of(action_spec), still)
        step = corrector.unchanged(still, still.new_zeros(still.shape[:-1]), bounds)
        return memory, self._report(memory, step._replace(enabled=~step.corrected))

    @torch.no_grad()
    def act(
        self,
        memory: Fields,
        planned: Tensor,
        action_spec: TensorSpec,
        key: NestedKey = "action",
        enabled: Tensor | None = None,
    ) -> tuple[Fields, Correction]:
        """Return the memory with the planned and the executed action, and the record of the step.

        Args:
            memory: up to the present state.
            planned: the planned action ``(*B, A)``; where it is not finite, the one before is
                taken.
            action_spec: actions that can be executed.
            key: where the planned action was found.
            enabled: which missions are corrected, ``(*B)``; None: all.

        Raises:
            ConfigurationError: for a plan that is not real numbers ``(*B, A)``.
        """
        check_precision()
        corrector, batch = self.corrector, memory["state"].shape[:-1]
        check_numbers(key, planned, (*batch, corrector.action_size))
        on = self._on(memory, enabled)
        # Sanitise: a plan of finite numbers, and what of it is within the action bounds.
        box = bounds_of(action_spec)
        planned, plan, inside = sanitised(planned, *box, memory)
        if plan is not planned:
            self._warn_of_plan(planned, key)
        # Bound: by the action bounds; where the correction is off, by the plan itself.
        ends = bounds = stacked(box, planned)
        if on is not None:
            ends = chosen(on, bounds, inside.unsqueeze(-2))
            memory = chosen_rows(on, memory, corrector.at_once(memory, inside))
        limits = limits_of(self.options, ends, inside, memory)
        # Correct, and limit: the executed action is finite and within the limits.
        memory, step = corrector.correct(memory, plan, self.model, ends, limits)
        self._warn(memory, step, on, ends, limits)
        # Hold: axes that act sooner than others are kept waiting.
        if corrector.holds:
            executed = corrector.sending(memory, step.executed_action)
            step = step._replace(executed_action=executed)
        # Report: in the precision of the actions.
        effect, reach = step.predicted_effect, step.effect_bounds
        if on is not None:
            effect, reach = chosen(on, effect, inside), chosen(on, reach, bounds)
        if not (self.options["extend_effect_bounds"] and self.model.extrapolates):
            reach = reach.clamp(bounds[..., :1, :], bounds[..., 1:, :])
        step = step._replace(planned_action=planned, predicted_effect=effect, effect_bounds=reach)
        step = step._replace(enabled=self.enabled_in(memory, enabled)).to(action_spec.dtype)
        if (recorder := self.options["record"]) is not None:
            recorder.acted(memory["state"], plan, step.executed_action)
        return memory, self._report(memory, step)

    @torch.no_grad()
    def observe(
        self, memory: Fields, state: Any, key: NestedKey = "observation", collect: bool = True
    ) -> Fields:
        """Return the memory with the state ``(*B, S)`` that was found under a key.

        With ``residual_steps`` the step is collected for the fit, unless ``collect`` is False;
        where the model is fitted now, the memory is that of a beginning.

        Raises:
            ConfigurationError: for anything but real numbers of this shape.
        """
        corrector, before = self.corrector, memory["state"]
        state = check_numbers(key, state, before.shape).to(before.dtype)
        if (recorder := self.options["record"]) is not None:
            recorder.observed(self.model, corrector.scale, state)
        memory, executed = corrector.observe(memory, state), memory["executed_action"]
        if self.residual is not None and collect:
            fitted = self.residual.add(before, executed, state)
            if fitted is not None:
                # Commands under way do not count: they belong to the old memory.
                begun = corrector.resume(corrector.begin(state, self.model), state, self.model)
                memory = chosen_rows(fitted, begun, memory)
        return memory

    def delay_in(self, memory: Fields, enabled: Tensor | None = None) -> Tensor:
        """Return in how many steps the next action acts, ``(*B)``; 0 where corrections are off."""
        steps, on = self.corrector.delay_in(memory), self._on(memory, enabled)
        return steps if on is None else steps * on

    def arrival(self, memory: Fields, enabled: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the state ``(*B, S)`` in which the next action acts, and in how many steps.

        The present state and 0 while no action is late, and where the correction is off.
        """
        steps = self.delay_in(memory, enabled)
        if none_holds(steps):
            return memory["state"], steps
        return state_at_arrival(self.corrector, memory, self.model, steps)

    def _on(self, memory: Fields, enabled: Tensor | None) -> Tensor | None:
        """Return which missions are corrected now, ``(*B)``; None: all."""
        if enabled is None and self.options["enabled"]:
            return None
        on = self.enabled_in(memory, enabled) & self.options["enabled"]
        return None if all_hold(on) else on

    def enabled_in(self, memory: Fields, enabled: Tensor | None) -> Tensor:
        """Return which missions of a memory are corrected, ``(*B)``; None: all."""
        batch, device = memory["state"].shape[:-1], memory["state"].device
        if enabled is None:
            return torch.ones(batch, dtype=torch.bool, device=device)
        return enabled.to(device, torch.bool).expand(batch)

    def _warn(
        self, memory: Fields, step: Correction, on: Tensor | None, bounds: Tensor, limits: Tensor
    ) -> None:
        """Note whether the step is corrected, and whether limits hold it back; warn once."""
        corrected = step.corrected if on is None else step.corrected & on
        cause = partial(self.corrector.cause_in, memory)
        self.first_steps(corrected, cause)
        if limits is not bounds:
            gap = (limits - step.executed_action.unsqueeze(-2)).abs()
            near = gap <= 1e-5 * bounds.diff(dim=-2)
            held = (near & (limits != bounds)).flatten(-2).any(-1)
            self.held_back(held & corrected, cause)

    def _check_model(self, state: Tensor, action_spec: TensorSpec) -> None:
        """Look once at what the model predicts of the lowest, middle and highest action."""
        unknown = isinstance(self.model, UnknownDynamics) or not may_look(state)
        if self._checked or unknown or state.shape[-1] != self.model.state_size:
            return
        low, high = (x.to(state) for x in bounds_of(action_spec))
        states = state.unsqueeze(-2).expand(*state.shape[:-1], 3, -1)
        actions = torch.stack([low, (low + high) / 2, high], -2).expand(*states.shape[:-1], -1)
        check_predictions(f"{self.owner}.model", self.model, states, actions)
        self._checked = bool(finite(state).any())

    def _warn_of_plan(self, planned: Tensor, key: NestedKey) -> None:
        """Warn once of a plan that is not finite."""
        if not self._warned and may_look(planned) and not bool(finite(planned).all()):
            warn(
                f"{self.owner}: {key!r} is not finite: what was planned before is taken instead, "
                "as in later steps; look at the policy"
            )
            self._warned = True

    def _report(self, memory: Fields, step: Correction) -> Correction:
        """Return the record with what the options request."""
        if self.options["belief"]:
            step = step._replace(belief=self.corrector.belief_in(memory))
        if self.residual is not None:
            step = step._replace(fitted=self.residual.fitted.to(step.corrected.device))
        return step


def chosen(mask: Tensor, there: Tensor, elsewhere: Tensor | float) -> Tensor:
    """Return what is where a mask ``(*B)`` holds, and elsewhere.

    >>> chosen(torch.tensor([True, False]), torch.ones(2, 3), 0.0).tolist()
    [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]
    """
    return torch.where(mask[(..., *[None] * (there.dim() - mask.dim()))], there, elsewhere)


def chosen_rows(mask: Tensor, there: Fields, elsewhere: Fields) -> Fields:
    """Return one memory where a mask ``(*B)`` holds, and another one elsewhere."""
    if there is elsewhere:
        return there
    return {name: chosen(mask, field, elsewhere[name]) for name, field in there.items()}
