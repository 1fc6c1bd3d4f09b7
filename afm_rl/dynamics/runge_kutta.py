"""Fourth-order Runge-Kutta steps, and how their end depends on their start."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from afm_rl.dynamics.derivatives import pushed_forward
from afm_rl.dynamics.rates import HeldRate


def runge_kutta(
    rate: Callable[[Tensor], Tensor], state: Tensor, dt: float, substeps: int
) -> Tensor:
    """Return the last state ``(*B, S)`` of :func:`runge_kutta_path`.

    >>> runge_kutta(torch.neg, torch.ones(1), 1.0, 4)  # exp(-1) = 0.36788
    tensor([0.3679])
    """
    return runge_kutta_path(rate, state, dt, substeps)[-1]


def runge_kutta_path(
    rate: Callable[[Tensor], Tensor], state: Tensor, dt: float, substeps: int
) -> list[Tensor]:
    r"""Integrate :math:`x' = f(x)` for ``dt`` seconds.

    Args:
        rate: f, ``(*B, S) -> (*B, S)``.
        state: where to start, ``(*B, S)``.
        dt: time (s).
        substeps: number of steps, N.

    Returns:
        The N states after each step, ``(*B, S)``.
    """
    step, path = dt / substeps, []
    for _ in range(substeps):
        first = rate(state)
        second = rate(torch.add(state, first, alpha=step / 2))
        third = rate(torch.add(state, second, alpha=step / 2))
        fourth = rate(torch.add(state, third, alpha=step))
        slope = torch.add(first + fourth, second + third, alpha=2.0)
        state = torch.add(state, slope, alpha=step / 6)
        path.append(state)
    return path


def runge_kutta_linearised(
    rate: HeldRate, state: Tensor, actions: int, dt: float, substeps: int
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Integrate :math:`x' = f(x, u)` together with the derivatives of x by its start and u.

    The chain rule through the stages:
    :math:`dk_i = \tfrac{\partial f}{\partial x}(x_i)\,dx_i + \tfrac{\partial f}{\partial u}(x_i)`.

    Args:
        rate: f under an action that is held.
        state: where to start, ``(*B, S)``.
        actions: number of action components, A.
        dt: time (s).
        substeps: number of steps.

    Returns:
        The state ``(*B, S)``, put back into the state space, and its derivatives ``(*B, S, S)``
        and ``(*B, S, A)``.

    >>> from afm_rl.dynamics.rates import HeldFunction
    >>> from afm_rl.spaces.manifold import Manifold
    >>> decay = HeldFunction(torch.zeros(1), lambda x, u: u - x, Manifold(1))
    >>> [part.item() for part in runge_kutta_linearised(decay, torch.ones(1), 1, 1.0, 4)]
    [0.3678..., 0.3678..., 0.6321...]
    """
    size, step = state.shape[-1], dt / substeps
    eye = torch.eye(size, size + actions, dtype=state.dtype, device=state.device)
    through = eye.expand(*state.shape[:-1], *eye.shape)
    for _ in range(substeps):
        total, slope = torch.zeros_like(state), torch.zeros_like(through)
        here, there = state, through
        for weight, reach in ((1, 0.5), (2, 0.5), (2, 1.0), (1, 0.0)):
            change, turn = rate.tangent(here, there)
            total = torch.add(total, change, alpha=weight)
            slope = torch.add(slope, turn, alpha=weight)
            if reach:
                here = torch.add(state, change, alpha=reach * step)
                there = torch.add(through, turn, alpha=reach * step)
        state = torch.add(state, total, alpha=step / 6)
        through = torch.add(through, slope, alpha=step / 6)
    state, through = pushed_forward(rate.finish, state, through)
    return state, through[..., :size], through[..., size:]
