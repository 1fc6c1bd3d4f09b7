"""The entries that action flow matching keeps in a tensordict, and the tick that renews them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from afm_rl.correction import ActionFlow, Corrector
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.faults import check_numbers, safe_action

LATE = ("predict", "leave")
"""What a policy is shown while its actions act late: the state at arrival, or the measured one."""
UNSEEN = "what is observed in the state in which they act is not known"


def corrector_for(
    owner: str,
    model: DynamicsModel,
    corrector: Corrector | None,
    action_spec: TensorSpec,
    delay: int | Sequence[int] | None = None,
) -> Corrector:
    """Return the corrector of an ``owner`` such as ``transform``: the universal one if None.

    That one is told a ``delay`` that is known.

    Raises:
        ConfigurationError: if a part is not what it should be, or they are of different actions.
    """
    check_precision()
    check_instance(f"{owner}.model", model, DynamicsModel)
    if corrector is None:
        low, high = bounds_of(action_spec)
        size = model.action_size
        if low.shape[-1] != size or not bool((high - low).isfinite().all()):
            raise ConfigurationError(
                f"{owner}: actions between {low.tolist()} and {high.tolist()}: expected the "
                f"{size} finite bounds of the dynamics model's actions; limit the action spec, or "
                "give a corrector with bounds of its own"
            )
        low, high = low.reshape(-1, size)[0], high.reshape(-1, size)[0]
        corrector = ActionFlow(low, high, delay=delay or 0)
    elif delay is not None:
        raise ConfigurationError(
            f"{owner}.delay={delay!r}: a corrector was given too; say it there, as in "
            f"ActionFlow(low, high, delay={delay!r})"
        )
    check_instance(f"{owner}.corrector", corrector, Corrector)
    if corrector.action_size != model.action_size:
        raise ConfigurationError(
            f"{owner}.corrector: made for {corrector.action_size} actions, but the dynamics model "
            f"has {model.action_size}"
        )
    return corrector


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


def entries_spec(corrector: Corrector, batch: torch.Size, dtype: torch.dtype) -> Composite:
    """Return the specs of the entries but the memory, for a batch shape and a type of actions."""
    actions = corrector.action_size

    def real(*shape: int) -> Unbounded:
        return Unbounded((*batch, *shape), dtype=dtype)

    return Composite(
        planned_action=real(actions),
        executed_action=real(actions),
        predicted_effect=real(actions),
        effect_bounds=real(2, actions),
        spread=real(actions),
        noise=real(actions),
        innovation=real(),
        misaligned=Binary(shape=batch, dtype=torch.bool),
        shape=batch,
    )


@torch.no_grad()
def begin(
    corrector: Corrector, state: Tensor, action_spec: TensorSpec, before: Tensor | None = None
) -> TensorDictBase:
    """Return the entries of missions that begin in ``state`` ``(*B, S)``.

    With what was learnt in a memory ``(*B, P)`` ``before``, if one is given.
    """
    check_precision()
    entries = entries_spec(corrector, state.shape[:-1], action_spec.dtype).to(state.device).zero()
    entries.set("effect_bounds", box_of(action_spec, entries.get("planned_action")))
    state = state.to(precise(state.dtype))
    if before is None or before.shape[:-1] != state.shape[:-1]:
        return entries.set("memory", corrector.begin(state))
    return entries.set("memory", corrector.resume(before.to(state), state))


@torch.no_grad()
def observe(
    memory: Tensor,
    state: Any,
    model: DynamicsModel,
    corrector: Corrector,
    key: NestedKey = "observation",
) -> Tensor:
    """Return the memory with the state ``(*B, S)`` that was found under a key.

    Raises:
        ConfigurationError: for anything but real numbers of this shape.
    """
    state = check_numbers(key, state, (*memory.shape[:-1], model.state_size))
    return corrector.observe(memory, state.to(memory.dtype))


def computable(plan: Tensor, low: Tensor, high: Tensor, dtype: torch.dtype) -> Tensor:
    r"""Return a plan ``(*B, A)`` in a precision, with NaN where it is infinite.

    Beyond the box by more than :math:`\varepsilon^{-1/2}` times its width, rounding would leave
    nothing of the box: there it is brought back to this distance.

    >>> computable(torch.tensor([1e30, 0.5]), -torch.ones(2), torch.ones(2), torch.float32)
    tensor([5.7936e+03, 5.0000e-01])
    """
    reach = torch.finfo(dtype).eps ** -0.5 * (high - low)
    near = torch.minimum(torch.maximum(plan, low - reach), high + reach)
    return torch.where(plan.isinf(), torch.nan, near).to(dtype)


def warn_of_old(tensordict: TensorDictBase, prefix: NestedKey) -> None:
    """Warn if a tensordict holds the entries of the next step already: it is an old one."""
    later = tensordict.get("next", None)
    if later is not None and later.get(prefix, None) is not None:
        warnings.warn(
            f"this step was made before: ('next', {prefix!r}) is in the tensordict, so its memory "
            "is an old one; go on with step_mdp(tensordict)",
            stacklevel=3,
        )


@torch.no_grad()
def correct(
    memory: Tensor,
    planned: Tensor,
    model: DynamicsModel,
    corrector: Corrector,
    action_spec: TensorSpec,
    enabled: bool = True,
    extend_action_box: bool = True,
    key: NestedKey = "action",
) -> TensorDictBase:
    """Return the entries with what was planned ``(*B, A)`` and what should be executed.

    Args:
        memory: up to the present state.
        planned: the planner's action; where it is not finite, the one before is taken.
        model: the dynamics model as it is now.
        corrector: the correction.
        action_spec: actions that can be executed.
        enabled: False to watch only.
        extend_action_box: note effects beyond the action box, if the model can predict them.
        key: where the planned action was found.

    Raises:
        ConfigurationError: for a plan that is not real numbers ``(*B, A)``.
    """
    check_precision()
    low, high = bounds_of(action_spec)
    check_numbers(key, planned, (*memory.shape[:-1], corrector.action_size))
    planned = computable(planned, low, high, memory.dtype)
    box = box_of(action_spec, planned)
    _, last, sent = corrector.latest(memory)
    plan = torch.where(planned.isfinite().all(-1, keepdim=True), planned, last)
    memory, found = corrector.correct(memory, plan, model, box)
    if enabled:
        corrector.first_steps(found.misaligned, partial(corrector.cause_in, memory))
    # The last clamp depends on nothing but the spec, whatever the corrector answers.
    executed, _ = safe_action(found.executed if enabled else plan, low, high, sent)
    executed, predicted = executed.to(memory.dtype), found.predicted
    if enabled:  # a corrector that keeps to the box has noted all of it
        memory = Corrector.executing(corrector, memory, plan, executed)
        executed = corrector.sending(memory, executed)
    else:
        memory, predicted = corrector.executing(memory, plan, executed), executed
    bounds = found.bounds if enabled else box
    if not (extend_action_box and model.extrapolates):
        low, high = box.unbind(-2)
        bounds = torch.minimum(torch.maximum(bounds, low.unsqueeze(-2)), high.unsqueeze(-2))
    entries = {
        "planned_action": planned,
        "executed_action": executed,
        "predicted_effect": predicted,
        "effect_bounds": bounds,
        "spread": found.spread if enabled else torch.zeros_like(found.spread),
        "noise": found.noise,
        "innovation": found.innovation,
    }
    entries = {name: value.to(action_spec.dtype) for name, value in entries.items()}
    entries |= {"misaligned": found.misaligned, "memory": memory}
    return TensorDict(entries, planned.shape[:-1], device=planned.device)


def bounds_of(action_spec: TensorSpec) -> tuple[Tensor, Tensor]:
    """Return the lowest and the highest action of a spec.

    Raises:
        ConfigurationError: if its actions are no real numbers between bounds.
    """
    space: Any = getattr(action_spec, "space", None)
    if not hasattr(space, "low") or not action_spec.dtype.is_floating_point:
        raise ConfigurationError(
            f"action_spec={action_spec}: expected a Bounded spec of real numbers; limit the "
            "environment's actions first"
        )
    return space.low, space.high


def box_of(action_spec: TensorSpec, like: Tensor) -> Tensor:
    """Return the action box for actions ``(*B, A)``: ``(*B, 2, A)``."""
    low, high = bounds_of(action_spec)
    return torch.stack([low.expand_as(like), high.expand_as(like)], -2).to(like)
