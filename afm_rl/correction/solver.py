"""Integration of a velocity field."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from afm_rl.errors import check_count

Velocity = Callable[[float, Tensor], Tensor]


def midpoint(velocity: Velocity, start: Tensor, steps: int) -> Tensor:
    r"""Integrate :math:`\dot x = v(\tau, x)` from 0 to 1 with the explicit midpoint rule.

    .. math:: x_{\tau+h} = x_\tau + h\, v(\tau + h/2,\; x_\tau + \tfrac h2 v(\tau, x_\tau))

    Second order: half the step, a quarter of the error.

    Args:
        velocity: v, takes the time and the point.
        start: x_0, ``(*B, A)``.
        steps: number of equal steps.

    >>> import torch
    >>> x = midpoint(lambda tau, x: x, torch.ones(1), 100)
    >>> abs(float(x) - 2.718281828) < 1e-4
    True
    """
    check_count("corrector.steps", steps)
    step, point = 1.0 / steps, start
    for k in range(steps):
        tau = k * step
        half = point + 0.5 * step * velocity(tau, point)
        point = point + step * velocity(tau + 0.5 * step, half)
    return point
