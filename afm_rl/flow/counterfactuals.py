"""Windows that a robot would have seen under another regime: what a context flow is trained on."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel
from afm_rl.flow.base import Corrector
from afm_rl.regimes import Regime
from afm_rl.sampling import draw_states

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
    expected, noise = model.forecast(state, inside)
    change = noise * torch.randn(noise.shape, generator=generator)
    out = (effect != inside).any(-1)  # derivatives are dear, and few effects are beyond the box
    slope = model.jacobian(state[out], inside[out])
    change[out] += (slope @ (effect - inside)[out].unsqueeze(-1)).squeeze(-1)
    return model.manifold.add(expected, change)


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


class Seen(NamedTuple):
    """Windows of K transitions."""

    state: Tensor
    """``(N, K, S)``."""
    executed: Tensor
    """``(N, K, A)``."""
    next_state: Tensor
    """``(N, K, S)``."""
    valid: Tensor
    """Which rows hold a transition, ``(N, K)``."""


def imagine_windows(
    flow: Corrector,
    model: DynamicsModel,
    regime: Regime,
    states: tuple[Tensor, Tensor] | Tensor,
    size: tuple[int, int],
    generator: torch.Generator,
) -> tuple[Seen, Tensor]:
    """Return windows under regimes drawn from a prior, and the present regimes ``(N, F)``.

    The older rows of half of them come from the regime before.

    Args:
        flow: whose actions they are.
        model: the world, before anything happens to it.
        regime: the prior.
        states: lowest and highest state, or a pool of them, ``(P, S)``.
        size: windows and their rows, (N, K).
        generator: of all that is drawn.
    """
    count, rows = size
    now, before = regime.sample((2, count), generator)
    row = torch.arange(rows).expand(size)
    fresh = row >= rows - rows_of_now(count, rows, generator)
    parameters = torch.where(fresh.unsqueeze(-1), now.unsqueeze(1), before.unsqueeze(1))
    valid = row >= rows - rows_filled(count, rows, generator)
    state = model.manifold.project(draw_states(states, count * rows, generator).view(*size, -1))
    executed = flow.denormalise(excite(*size, flow.action_size, generator))
    effect = regime.apply(executed, parameters, state)
    low, high = flow.centre - flow.half_range, flow.centre + flow.half_range
    reached = state.clone()  # rows that do not count need no model
    reached[valid] = imagine(model, state[valid], effect[valid], low, high, generator)
    return Seen(state, executed, reached, valid), now


def anywhere(flow: Corrector, count: int, generator: torch.Generator) -> Tensor:
    """Return actions ``(N, A)`` from all over the box."""
    return flow.denormalise(2 * torch.rand(count, flow.action_size, generator=generator) - 1)


def draw_plans(
    flow: Corrector,
    regime: Regime,
    parameters: Tensor,
    state: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return plans ``(N, A)``: half of them in the box, the others effects that can be had."""
    count = len(state)
    inside = torch.rand(count, 1, generator=generator) < 0.5
    plan, action = (anywhere(flow, count, generator) for _ in range(2))
    return torch.where(inside, plan, regime.apply(action, parameters, state))
