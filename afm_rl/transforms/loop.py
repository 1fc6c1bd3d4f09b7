"""The loop around a corrector: begin, act, observe; transform, policy and wrappers are views."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Unpack

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from afm_rl.compiling.tracing import all_hold, may_look
from afm_rl.correction import ActionFlow, Corrector
from afm_rl.dynamics import DynamicsModel, LinearResidual, UnknownDynamics
from afm_rl.dynamics.predictions import check_predictions
from afm_rl.errors import ConfigurationError, check_instance, warn
from afm_rl.faults import check_numbers, finite, safe_action
from afm_rl.options import filled
from afm_rl.transforms.delay_compensation import state_at_arrival
from afm_rl.transforms.loop_options import LoopOptions

LEAST_STEPS = 50  # to which a model is fitted


class CorrectionLoop:
    r"""Begin, act, observe: the correction of one environment or of a batch ``(*B)`` of them.

    Each step is a pure function of the corrector's memory ``(*B, P)``, which belongs to the caller,
    as do action spec and state. While the model explains what happens, the planned action is
    executed; when it does not, the corrector's answer is (paper, section IV-C). It never learns and
    never changes the model. What it tells of a step, in a tensordict ``(*B)``:

    * ``"planned_action"`` and ``"executed_action"`` ``(*B, A)``,
    * ``"predicted_effect"`` ``(*B, A)``: the effect that the executed action is predicted to have;
      where nothing is corrected, itself,
    * ``"enabled"`` ``(*B)``: is this mission corrected? True at first; a caller may set it to False
      until the mission ends, as ``enabled=False`` does for all missions,
    * ``"misaligned"`` ``(*B)``: does the model misjudge actions, so that they are corrected (while
      that is switched off: so that they would be)?
    * ``"innovation"`` ``(*B)``: the misalignment, in standard deviations that the model states,
    * ``"noise"`` ``(*B, A)``: standard deviation of effects that nothing explains,
    * ``"effect_bounds"`` ``(*B, 2, A)``: lowest and highest effect that plans should
      keep to, narrower or wider than the action box: for a planner's ``box_key``,
    * ``"belief"`` ``(*B, C, A)``, if it is asked for: how probable the ``causes`` of the
      corrector are, by axis,
    * ``"memory"`` ``(*B, P)``.

    Args:
        owner: whose options these are, for messages.
        model: dynamics model, shared with planner and updater; None: said by :meth:`complete`.
        corrector: the correction, owned; None: an
            :class:`~afm_rl.correction.ActionFlow` for the action box.
        options: those of :class:`~afm_rl.transforms.loop_options.LoopOptions`, by name.

    Raises:
        ConfigurationError: for options that cannot be used, or parts that do not fit each other.

    >>> from torchrl.data import Bounded
    >>> from afm_rl.dynamics import Dubins
    >>> spec = Bounded(torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5]))
    >>> loop, state = CorrectionLoop("example").complete(Dubins(), spec), torch.zeros(3)
    >>> entries = loop.begin(state, spec)
    >>> for _ in range(8):  # both motors are reversed
    ...     entries = loop.act(entries["memory"], torch.tensor([0.5, 0.2]), spec)
    ...     state = Dubins()(state, -entries["executed_action"])
    ...     entries["memory"] = loop.observe(entries["memory"], state)
    >>> entries["executed_action"].round(decimals=1)
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
        steps = self.options["residual_steps"]
        if 0 < steps < LEAST_STEPS:
            raise ConfigurationError(
                f"{owner}.residual_steps={steps}: expected 0, or at least {LEAST_STEPS} steps"
            )
        self._checked = self._told = False
        record = self.options["record"]
        if isinstance(record, str | Path):
            from afm_rl.transforms.record import Recorder

            self.options["record"] = Recorder(record)
        elif record is not None and not hasattr(record, "acted"):
            raise ConfigurationError(f"{owner}.record={record!r}: expected a new file NAME.csv")

    def changed(self, **options: Unpack[LoopOptions]) -> CorrectionLoop:
        """Return the same loop with other options."""
        loop = CorrectionLoop(self.owner, self.model, self.corrector, **(self.options | options))
        loop.residual = self.residual
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
        for name in ("most", "rate"):
            limit = self.options[name]
            if isinstance(limit, list) and len(limit) != size:
                raise ConfigurationError(
                    f"{owner}.{name}={limit}: expected one number, or {size}, one per action"
                )
        if self.options["belief"]:
            if not corrector.causes:
                raise ConfigurationError(
                    f"{owner}.belief=True: {owner}.corrector={type(corrector).__name__} has no "
                    "causes to believe in: give an ActionFlow, or leave belief out"
                )
        loop = CorrectionLoop(owner, model, corrector, **self.options)
        loop.residual = self.residual
        if self.options["residual_steps"] and loop.residual is None:
            loop._fit_later()
        return loop

    def _fit_later(self) -> None:
        """Let the model be fitted to the first steps."""
        from afm_rl.transforms.residual_steps import ResidualSteps

        steps, corrector = self.options["residual_steps"], self.corrector
        if isinstance(self.model, UnknownDynamics):
            raise ConfigurationError(
                f"{self.owner}.residual_steps={steps}: there is no nominal model yet to which a "
                "residual could be added; leave it out with model='learn'"
            )
        if isinstance(self.model, LinearResidual):
            raise ConfigurationError(
                f"{self.owner}.residual_steps={steps}: the model was fitted before; leave "
                "residual_steps out, or give the nominal model, model.model"
            )
        self.model = LinearResidual(self.model)
        largest = (corrector.home.abs() + corrector.scale).detach()
        self.residual = ResidualSteps(self.model, steps, corrector.delay, largest)

    def spec(self, batch: torch.Size, dtype: torch.dtype, memory: torch.dtype) -> Composite:
        """Return the specs of the entries but the memory, for types of actions and memory."""
        actions = self.corrector.action_size

        def real(*shape: int) -> Unbounded:
            return Unbounded((*batch, *shape), dtype=dtype)

        spec = Composite(
            planned_action=real(actions),
            executed_action=real(actions),
            predicted_effect=real(actions),
            effect_bounds=real(2, actions),
            noise=real(actions),
            innovation=real(),
            enabled=Binary(shape=batch, dtype=torch.bool),
            misaligned=Binary(shape=batch, dtype=torch.bool),
            shape=batch,
        )
        if self.residual is not None:
            spec["fitted"] = Binary(shape=batch, dtype=torch.bool)
        if self.options["belief"]:
            size = (*batch, len(self.corrector.causes), actions)
            spec["belief"] = Unbounded(size, dtype=memory)
        return spec

    @torch.no_grad()
    def begin(
        self, state: Tensor, action_spec: TensorSpec, learnt: Tensor | None = None
    ) -> TensorDictBase:
        """Return the entries of missions that begin in ``state`` ``(*B, S)``.

        With what was learnt in a memory ``(*B, P)``, if one is given.
        """
        check_precision()
        state = state.to(precise(state.dtype))
        self._check_model(state, action_spec)
        if self.residual is not None:
            self.residual.begin(state)
        entries = self.spec(state.shape[:-1], action_spec.dtype, state.dtype).to(state.device)
        entries = entries.zero()
        entries.set("effect_bounds", box_of(action_spec, entries.get("planned_action")))
        entries.set("enabled", ~entries.get("enabled"))
        if learnt is None or learnt.shape[:-1] != state.shape[:-1]:
            memory = self.corrector.begin(state)
        else:
            memory = self.corrector.resume(learnt.to(state), state)
        return self._completed(entries.set("memory", memory))

    @torch.no_grad()
    def act(
        self,
        memory: Tensor,
        planned: Tensor,
        action_spec: TensorSpec,
        key: NestedKey = "action",
        enabled: Tensor | None = None,
    ) -> TensorDictBase:
        """Return the entries with what was planned ``(*B, A)`` and what should be executed.

        Args:
            memory: up to the present state.
            planned: the planned action; where it is not finite, the one before is taken.
            action_spec: actions that can be executed.
            key: where the planned action was found.
            enabled: which missions are corrected, ``(*B)``; None: all.

        Raises:
            ConfigurationError: for a plan that is not real numbers ``(*B, A)``.
        """
        check_precision()
        model, corrector = self.model, self.corrector
        low, high = bounds_of(action_spec)
        check_numbers(key, planned, (*memory.shape[:-1], corrector.action_size))
        enabled = self.enabled_in(memory, enabled)
        corrected = enabled & self.options["enabled"]
        on = None if all_hold(corrected) else corrected

        # Sanitise: a finite plan, and what of it is inside the box.
        _, last, sent = corrector.latest(memory)
        planned, plan, inside = sanitised(planned, low, high, last, sent, memory.dtype)
        if plan is not planned:
            self._look_at(planned, key)

        # Limit: to the box, and so far from the plan; to the plan where nothing is corrected.
        box = box_of(action_spec, planned)
        limits = self._limits(box, inside, sent.clamp(low, high) - last.clamp(low, high))
        ends = chosen(on, limits, inside.unsqueeze(-2))
        limited = [] if limits is box else [ends]

        # Correct.
        before = chosen(on, memory, corrector.at_once(memory, inside))
        alone = chosen(on, box, inside.unsqueeze(-2))
        memory, answer = corrector.correct(before, plan, model, alone, *limited)
        lowest, highest = ends.unbind(-2)
        executed, _ = safe_action(answer.executed, lowest, highest, sent)
        executed = executed.to(memory.dtype)
        # A corrector that keeps to the box has noted all of it.
        memory = Corrector.executing(corrector, memory, plan, executed)
        cause = partial(corrector.cause_in, memory)
        corrector.first_steps(answer.misaligned & corrected, cause)
        if limited:
            near = (limits - executed.unsqueeze(-2)).abs() <= 1e-5 * (high - low)
            held = near & (limits != box)
            corrector.held_back(held.flatten(-2).any(-1) & answer.misaligned & corrected, cause)

        # Hold: axes that act sooner than others are kept waiting.
        predicted = chosen(on, answer.predicted, executed)
        executed = chosen(on, corrector.sending(memory, executed), executed)

        # Report.
        bounds = chosen(on, answer.bounds, box)
        if not (self.options["extend_action_box"] and model.extrapolates):
            bounds = bounds.clamp(box[..., :1, :], box[..., 1:, :])
        entries = {
            "planned_action": planned,
            "executed_action": executed,
            "predicted_effect": predicted,
            "effect_bounds": bounds,
            "noise": answer.noise,
            "innovation": answer.innovation,
        }
        entries = {name: value.to(action_spec.dtype) for name, value in entries.items()}
        entries |= {"enabled": enabled, "misaligned": answer.misaligned, "memory": memory}
        if (recorder := self.options["record"]) is not None:
            recorder.acted(corrector.latest(memory)[0], plan, entries["executed_action"])
        return self._completed(TensorDict(entries, planned.shape[:-1], device=planned.device))

    @torch.no_grad()
    def observe(
        self, memory: Tensor, state: Any, key: NestedKey = "observation", collect: bool = True
    ) -> Tensor:
        """Return the memory with the state ``(*B, S)`` that was found under a key.

        With ``residual_steps`` the step is collected for the fit, unless ``collect`` is False;
        where the model is fitted now, the memory is that of a beginning.

        Raises:
            ConfigurationError: for anything but real numbers of this shape.
        """
        state = check_numbers(key, state, (*memory.shape[:-1], self.model.state_size))
        state = state.to(memory.dtype)
        if (recorder := self.options["record"]) is not None:
            recorder.observed(self.model, self.corrector.scale, state)
        observed = self.corrector.observe(memory, state)
        if self.residual is not None and collect:
            before, _, executed = self.corrector.latest(memory)
            fitted = self.residual.add(before, executed, state)
            if fitted is not None:
                # Commands that are under way do not count: they were those of the old memory.
                begun = self.corrector.resume(self.corrector.begin(state), state)
                observed = chosen(fitted, begun, observed)
        return observed

    def arrival(self, memory: Tensor, enabled: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the state ``(*B, S)`` in which the next action acts, and in how many steps.

        The present state and 0 while no action is late, and where the correction is off.
        """
        on = self.enabled_in(memory, enabled) & self.options["enabled"]
        if all_hold(on):
            return state_at_arrival(self.corrector, memory, self.model)
        now = self.corrector.latest(memory)[0]
        if all_hold(~on):
            return now, torch.zeros_like(now[..., 0], dtype=torch.long)
        state, steps = state_at_arrival(self.corrector, memory, self.model)
        return torch.where(on.unsqueeze(-1), state, now), torch.where(on, steps, 0)

    def enabled_in(self, memory: Tensor, enabled: Tensor | None) -> Tensor:
        """Return which missions of a memory ``(*B, P)`` are corrected, ``(*B)``; None: all."""
        if enabled is None:
            return memory.new_ones(memory.shape[:-1], dtype=torch.bool)
        return enabled.to(memory.device, torch.bool).expand(memory.shape[:-1])

    def _limits(self, box: Tensor, plan: Tensor, correction: Tensor) -> Tensor:
        """Return the lowest and the highest action ``(*B, 2, A)`` that may be executed.

        Args:
            box: those of the spec, ``(*B, 2, A)``.
            plan: the planned action, in the box, ``(*B, A)``.
            correction: the last executed action minus the planned one.
        """
        rate, most = self.options["rate"], self.options["most"]
        low, high = box.split(1, -2)
        ends = box
        for limit, centre in ((rate, plan + correction), (most, plan)):
            if limit is not None:  # what comes last holds in any case
                reach = 0.5 * (high - low) * torch.as_tensor(limit).to(box)
                centre = centre.unsqueeze(-2)
                ends = ends.clamp(centre - reach, centre + reach).clamp(low, high)
        return ends

    def _check_model(self, state: Tensor, action_spec: TensorSpec) -> None:
        """Look once at what the model predicts of the lowest, middle and highest action."""
        unknown = isinstance(self.model, UnknownDynamics) or not may_look(state)
        if self._checked or unknown or state.shape[-1] != self.model.state_size:
            return
        low, high = (x.to(state) for x in bounds_of(action_spec))
        box = torch.stack([low, (low + high) / 2, high], -2)
        states = state.unsqueeze(-2).expand(*state.shape[:-1], 3, -1)
        actions = box.expand(*states.shape[:-1], -1)
        check_predictions(f"{self.owner}.model", self.model, states, actions)
        self._checked = bool(finite(state).any())

    def _look_at(self, planned: Tensor, key: NestedKey) -> None:
        """Say once that a plan is not finite."""
        if not self._told and may_look(planned) and not bool(finite(planned).all()):
            warn(
                f"{self.owner}: {key!r} is not finite: what was planned before is taken instead, "
                "as in later steps; look at the policy"
            )
            self._told = True

    def _completed(self, entries: TensorDictBase) -> TensorDictBase:
        if self.options["belief"]:
            entries.set("belief", self.corrector.belief_in(entries.get("memory")))
        if self.residual is not None:
            entries.set("fitted", self.residual.fitted.to(entries.device))
        return entries


def precise(dtype: torch.dtype) -> torch.dtype:
    """Return the type in which numbers are remembered: theirs, or single precision for 16 bits."""
    return dtype if dtype in (torch.float32, torch.float64) else torch.float32


def check_precision() -> None:
    """Refuse a default type of 16 bits, in which the belief would be computed."""
    if torch.get_default_dtype().itemsize < 4:
        raise ConfigurationError(
            f"torch.get_default_dtype() is {torch.get_default_dtype()}: expected float32 or "
            "float64 while actions are corrected; set_default_dtype(torch.float32), and give "
            "16 bits to the policy alone"
        )


def chosen(mask: Tensor | None, there: Tensor, elsewhere: Tensor | float) -> Tensor:
    """Return what is where a mask ``(*B)`` holds, everywhere if it is None, and elsewhere.

    >>> chosen(torch.tensor([True, False]), torch.ones(2, 3), 0.0).tolist()
    [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]
    """
    if mask is None:
        return there
    return torch.where(mask[(..., *[None] * (there.dim() - mask.dim()))], there, elsewhere)


def sanitised(
    planned: Tensor, low: Tensor, high: Tensor, last: Tensor, sent: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a planned action in a precision, what is taken for it, and what of that is in the box.

    Args:
        planned: ``(*B, A)``, of any real numbers.
        low: lowest action.
        high: highest action.
        last: the plan before, which is taken where this one is not finite.
        sent: the action before.
        dtype: the precision.
    """
    if all_hold((planned >= low) & (planned <= high)):  # as most are: nothing to be done
        planned = planned.to(dtype, copy=True)
        return planned, planned, planned
    planned = computable(planned, low, high, dtype)
    plan = torch.where(finite(planned).unsqueeze(-1), planned, last)
    inside, _ = safe_action(plan, low, high, sent)
    return planned, plan, inside.to(dtype)


def computable(plan: Tensor, low: Tensor, high: Tensor, dtype: torch.dtype) -> Tensor:
    r"""Return a plan ``(*B, A)`` in a precision, with NaN where it is infinite.

    Beyond the box by more than :math:`\varepsilon^{-1/2}` times its width, rounding would leave
    nothing of the box: there it is brought back to this distance.

    >>> computable(torch.tensor([1e30, 0.5]), -torch.ones(2), torch.ones(2), torch.float32)
    tensor([5.7936e+03, 5.0000e-01])
    """
    reach = torch.finfo(dtype).eps ** -0.5 * (high - low)
    near = plan.clamp(low - reach, high + reach)
    return torch.where(plan.abs() < torch.inf, near, torch.nan).to(dtype)


def warn_of_old(tensordict: TensorDictBase, prefix: NestedKey) -> None:
    """Warn if a tensordict holds the entries of the next step already: it is an old one."""
    later = tensordict.get("next", None)
    if later is not None and later.get(prefix, None) is not None:
        warn(
            f"this step was made before: ('next', {prefix!r}) is in the tensordict, so its memory "
            "is an old one; go on with step_mdp(tensordict)"
        )


def bounds_of(action_spec: TensorSpec | None) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest action of a spec.

    Raises:
        ConfigurationError: if its actions are no real numbers between bounds.
    """
    space: Any = getattr(action_spec, "space", None)
    if not hasattr(space, "low") or not action_spec.dtype.is_floating_point:  # type: ignore[union-attr]
        raise ConfigurationError(
            f"action_spec={action_spec}: expected a Bounded spec of real numbers; limit the "
            "environment's actions first"
        )
    return space.low, space.high


def box_of(action_spec: TensorSpec, like: Tensor) -> Tensor:
    """Return the action box for actions ``(*B, A)``: ``(*B, 2, A)``."""
    low, high = bounds_of(action_spec)
    return torch.stack([low.expand_as(like), high.expand_as(like)], -2).to(like)


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
