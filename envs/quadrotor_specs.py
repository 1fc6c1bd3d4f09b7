"""What the entries of a quadrotor's tensordict look like."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.data import Bounded, Categorical, Composite, Unbounded


def state_spec(mission: Composite, dtype: torch.dtype, history: int) -> Composite:
    """Return the entries that make up the state: what a step starts from.

    Previous actions ``(*B, history, 4)`` are among them if the regime depends on some.
    """
    batch, device = mission.shape, mission.device
    spec = Composite(
        pose=Unbounded(shape=(*batch, 13), dtype=dtype, device=device),
        step=Unbounded(shape=batch, dtype=torch.int64, device=device),
        since=Unbounded(shape=batch, dtype=torch.int64, device=device),
        lost=Categorical(2, shape=batch, dtype=torch.bool, device=device),
        mission=mission.clone(),
        shape=batch,
        device=device,
    )
    if history:
        spec["past"] = Unbounded(shape=(*batch, history, 4), dtype=dtype, device=device)
    return spec


def observation_spec(
    state: Composite, horizon: int, parameters: int, trace: int | None = None
) -> Composite:
    """Return what reset and step emit: the state, so that it is carried, and views of it.

    Args:
        state: see :func:`state_spec`.
        horizon: ticks by which the reference looks ahead.
        parameters: number of the regime's parameters.
        trace: number of states in the trace; None for none.
    """
    batch, device, dtype = state.shape, state.device, state["pose"].dtype
    spec = state.clone()
    sizes = {
        "observation": (13,),
        "reference": (horizon + 1, 6),
        "square_error": (3,),
        "regime": (parameters,),
    }
    if trace is not None:
        sizes["trace"] = (trace, 13)
    for name, size in sizes.items():
        spec[name] = Unbounded(shape=(*batch, *size), dtype=dtype, device=device)
    spec["phase"] = Unbounded(shape=batch, dtype=torch.int64, device=device)
    spec["regime_active"] = Categorical(2, shape=batch, dtype=torch.bool, device=device)
    return spec


def action_spec(bounds: Sequence[Sequence[float]], state: Composite) -> Composite:
    """Return the box of the actions: thrust (N) and moments (N m), lowest and highest."""
    shape = torch.Size((*state.shape, 4))
    dtype, device = state["pose"].dtype, state.device
    low, high = (torch.tensor(bound, dtype=dtype, device=device).expand(shape) for bound in bounds)
    box = Bounded(low=low, high=high, shape=shape, dtype=dtype, device=device)
    return Composite(action=box, shape=state.shape, device=device)
