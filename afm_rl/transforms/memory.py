"""What action flow matching remembers of a mission, and what it does with it."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_flag, check_instance
from afm_rl.flow import Context, Correction, Corrector, Window
from afm_rl.flow.base import rows_of


def check_parts(
    owner: str, model: DynamicsModel, flow: Corrector, enabled: bool, extend_action_box: bool
) -> None:
    """Check what corrects actions, for an ``owner`` such as ``transform``.

    Raises:
        ConfigurationError: if a part is not what it should be, or flow and model are of
            different actions.
    """
    check_instance(f"{owner}.model", model, DynamicsModel)
    check_instance(f"{owner}.flow", flow, Corrector)
    check_flag(f"{owner}.enabled", enabled)
    check_flag(f"{owner}.extend_action_box", extend_action_box)
    if flow.action_size != model.action_size:
        raise ConfigurationError(
            f"flow: made for {flow.action_size} actions, but the dynamics model has "
            f"{model.action_size}"
        )


def memory_spec(
    model: DynamicsModel, flow: Corrector, batch: torch.Size, dtype: torch.dtype
) -> Composite:
    """Return the specs of the memory for a batch shape."""
    states, actions, window = model.state_size, model.action_size, flow.window

    def real(*shape: int) -> Unbounded:
        return Unbounded((*batch, *shape), dtype=dtype)

    def flag(*shape: int) -> Binary:
        return Binary(shape=(*batch, *shape), dtype=torch.bool)

    rows = Composite(
        state=real(window, states),
        planned=real(window, actions),
        executed=real(window, actions),
        next_state=real(window, states),
        valid=flag(window),
        shape=batch,
    )
    return Composite(
        state=real(states),
        window=rows,
        pairs=real(window, flow.pair_size),
        evidence=real(flow.evidence_size),
        features=real(flow.context_size),
        surprise=real(),
        misaligned=flag(),
        planned_action=real(actions),
        executed_action=real(actions),
        expected_action=real(actions),
        spread=real(actions),
        reach=real(2, actions),
        shape=batch,
    )


def begin(
    model: DynamicsModel, flow: Corrector, state: Tensor, action_spec: TensorSpec
) -> TensorDictBase:
    """Return the memory of a mission that begins in ``state`` ``(*B, S)``."""
    spec = memory_spec(model, flow, state.shape[:-1], state.dtype)
    memory = spec.to(state.device).zero()
    memory.set("reach", box_of(action_spec, memory.get("planned_action")))
    return memory.set("state", state.clone())


def correct(
    memory: TensorDictBase,
    planned: Tensor,
    model: DynamicsModel,
    flow: Corrector,
    action_spec: TensorSpec,
    enabled: bool = True,
    extend_action_box: bool = True,
) -> TensorDictBase:
    """Return the memory with what was planned ``(*B, A)`` and what should be executed.

    Args:
        memory: up to the present state.
        planned: the planner's action.
        model: the dynamics model as it is now.
        flow: the correction.
        action_spec: actions that can be executed.
        enabled: False to watch only.
        extend_action_box: note effects beyond the action box, if the model can foresee them.
    """
    window = Window(*(memory.get(("window", name)) for name in Window._fields))
    last = Context(*(memory.get(name) for name in Context._fields))
    box = box_of(action_spec, planned)
    with torch.no_grad():
        context = flow.context(window, model, last)
        use = context.misaligned & enabled
        expected = planned.clone()
        found = Correction(planned.clone(), torch.zeros_like(planned), box, expected)
        if bool(use.any()):
            state = memory.get("state")
            found = _corrected(found, expected, use, context, state, model, flow, extend_action_box)
    executed = found.action.clamp(*box.unbind(-2))
    expected = torch.where(use.unsqueeze(-1), expected, executed)
    memory = memory.clone(recurse=False)
    memory.update(context._asdict())
    memory.set("planned_action", planned)
    memory.set("executed_action", executed)
    memory.set("expected_action", expected)
    memory.set("spread", found.spread)
    return memory.set("reach", found.reach)


def observe(memory: TensorDictBase, next_state: Tensor) -> TensorDictBase:
    """Return the memory with the transition to ``next_state`` ``(*B, S)`` in its window."""
    memory, state = memory.clone(recurse=False), memory.get("state")
    planned, executed = memory.get("planned_action"), memory.get("executed_action")
    valid = next_state.isfinite().all(-1) & state.isfinite().all(-1)
    newest = Window(state, planned, executed, next_state, valid)
    window, at = memory.get("window").clone(recurse=False), valid.dim()
    for name, value in newest._asdict().items():
        rows = window.get(name)
        kept = rows.narrow(at, 1, rows.shape[at] - 1)
        window.set(name, torch.cat([kept, value.unsqueeze(at)], at))
    memory.set("window", window)
    return memory.set("state", next_state.clone())


def box_of(action_spec: TensorSpec, like: Tensor) -> Tensor:
    """Return the action box for actions ``(*B, A)``: ``(*B, 2, A)``."""
    space = action_spec.space
    return torch.stack([space.low.expand_as(like), space.high.expand_as(like)], -2).to(like)


def _corrected(
    found: Correction,
    expected: Tensor,
    use: Tensor,
    context: Context,
    state: Tensor,
    model: DynamicsModel,
    flow: Corrector,
    extend_action_box: bool,
) -> Correction:
    """Put the flow's answers where ``use`` ``(*B)`` says so, in place."""
    executed, spread, reach, _ = found
    use = rows_of(use)
    planned = executed[use].clone()
    shown = Context(*(part[use] for part in context))
    answer = flow.correct(shown, state[use], planned)
    sound = answer.action.isfinite().all(-1, keepdim=True)
    executed[use] = torch.where(sound, answer.action, planned)
    spread[use] = torch.where(sound, answer.spread, 0.0)
    if answer.expected is not None:
        known = sound & answer.expected.isfinite().all(-1, keepdim=True)
        expected[use] = torch.where(known, answer.expected, planned)
    if answer.reach is not None and reach is not None and extend_action_box and model.extrapolates:
        # Never a smaller box: what cannot be had the flow cuts, and it knows better.
        told = sound.unsqueeze(-1) & answer.reach.isfinite()
        low, high = torch.where(told, answer.reach, reach[use]).unbind(-2)
        least, most = reach[use].unbind(-2)
        widened = [torch.minimum(least, low), torch.maximum(most, high)]
        reach[use] = torch.stack(widened, -2)
    return found
