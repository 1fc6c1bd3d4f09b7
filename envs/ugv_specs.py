"""What the entries of a ground robot's tensordict look like."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded


def state_spec(mission: Composite, dtype: torch.dtype, history: int) -> Composite:
    """Return the entries that make up the state: what a step starts from.

    Previous actions ``(*B, history, 2)`` are among them if the regime depends on some.
    """
    batch, device = mission.shape, mission.device
    spec = Composite(
        pose=Unbounded(shape=(*batch, 3), dtype=dtype, device=device),
        reached=Unbounded(shape=batch, dtype=torch.int64, device=device),
        step=Unbounded(shape=batch, dtype=torch.int64, device=device),
        since=Unbounded(shape=batch, dtype=torch.int64, device=device),
        mission=mission.clone(),
        shape=batch,
        device=device,
    )
    if history:
        spec["past"] = Unbounded(shape=(*batch, history, 2), dtype=dtype, device=device)
    return spec


def observation_spec(state: Composite, parameters: int) -> Composite:
    """Return what reset and step emit: the state, so that it is carried, and views of it."""
    batch, device, dtype = state.shape, state.device, state["pose"].dtype
    spec = state.clone()
    for name, size in (("observation", 3), ("goal", 2), ("regime", parameters)):
        spec[name] = Unbounded(shape=(*batch, size), dtype=dtype, device=device)
    spec["regime_active"] = Categorical(2, shape=batch, dtype=torch.bool, device=device)
    return spec


def action_spec(low: Tensor, high: Tensor, batch: torch.Size, device) -> Composite:
    """Return the box of the actions v (m/s), omega (rad/s)."""
    shape = torch.Size((*batch, 2))
    box = Bounded(
        low=low.expand(shape), high=high.expand(shape), shape=shape, dtype=low.dtype, device=device
    )
    return Composite(action=box, shape=batch, device=device)


def reward_spec(state: Composite) -> Composite:
    """Return the reward, in metres and targets."""
    leaf = Unbounded(shape=(*state.shape, 1), dtype=state["pose"].dtype, device=state.device)
    return Composite(reward=leaf, shape=state.shape, device=state.device)


def done_spec(state: Composite) -> Composite:
    """Return the three flags that end an episode."""
    shape = (*state.shape, 1)
    flags = {
        name: Categorical(2, shape=shape, dtype=torch.bool, device=state.device)
        for name in ("done", "terminated", "truncated")
    }
    return Composite(flags, shape=state.shape, device=state.device)
