"""Windows that a robot would have seen under another regime: what a context flow is trained on."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel

EDGE = 1.6  # actions are drawn about centres in this box of half ranges, and cut: many saturate


def imagine(
    model: DynamicsModel,
    state: Tensor,
    effect: Tensor,
    low: Tensor,
    high: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return noisy next states ``(*B, S)`` under effective actions, also beyond the box.

    A learned model knows nothing outside the box, so it is continued linearly from its edge.
    """
    inside = torch.minimum(torch.maximum(effect, low), high)
    state_at_edge, noise = model.forecast(state, inside)
    slope = model.jacobian(state, inside)
    beyond = (slope @ (effect - inside).unsqueeze(-1)).squeeze(-1)
    error = noise * torch.randn(noise.shape, generator=generator)
    return model.manifold.add(state_at_edge, beyond + error)


def rows_of_now(count: int, window: int, generator: torch.Generator) -> Tensor:
    """How many rows are from the present regime ``(N, 1)``: all in half of the windows."""
    some = torch.randint(1, window + 1, (count, 1), generator=generator)
    full = torch.rand(count, 1, generator=generator) < 0.5
    return torch.where(full, window, some)


def rows_filled(count: int, window: int, generator: torch.Generator) -> Tensor:
    """How many rows are filled ``(N, 1)``: as many as views fill, or any number."""
    usual = torch.tensor([max(1, round(window / 6)), max(1, window // 2), window])
    kind = torch.randint(4, (count, 1), generator=generator)
    some = torch.randint(1, window + 1, (count, 1), generator=generator)
    return torch.where(kind == 3, some, usual[kind.clamp_max(2)])


def excite(count: int, window: int, size: int, generator: torch.Generator) -> Tensor:
    """Executed actions ``(N, K, A)`` in u: half the windows move about one action only."""
    wide = 2 * torch.rand(count, window, size, generator=generator) - 1
    around = EDGE * (2 * torch.rand(count, 1, size, generator=generator) - 1)
    reach = 0.4 * torch.rand(count, 1, size, generator=generator)
    narrow = (around + reach * wide).clamp(-1, 1)
    return torch.where(torch.rand(count, 1, 1, generator=generator) < 0.5, wide, narrow)
