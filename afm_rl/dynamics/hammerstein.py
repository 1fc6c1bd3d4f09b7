"""Static shapes of actuators: what a Hammerstein model puts before its linear part."""

from __future__ import annotations

import math

import torch
from torch import Tensor

PLAIN = (0.0, math.inf, 0.0)
"""The shape that changes nothing: no dead zone, no limit, no slip."""


def shaped(unit: Tensor, shape: Tensor) -> Tensor:
    r"""Return what is left of a command behind a limit, a dead zone and slipping wheels.

    .. math:: \psi(u) = z\,e^{-\kappa |z|},\qquad z = y - \mathrm{clamp}(y, -d, d),\qquad
              y = \mathrm{clamp}(u, -l, l)

    each axis for itself; exactly u for :data:`PLAIN`.

    Args:
        unit: u, the command in half ranges, ``(*B, A)``.
        shape: d >= 0, l > 0 and kappa >= 0, ``(*B, 3)``, the same for all axes.

    >>> shaped(torch.tensor([0.5, -2.0]), torch.tensor([0.25, 1.0, 0.0]))
    tensor([ 0.2500, -0.7500])
    """
    dead, limit, slip = shape.unsqueeze(-2).unbind(-1)
    inside = unit.clamp(-limit, limit)
    # Without a dead zone there is nothing to take off: the slope at u = 0 is then 1.
    driven = torch.where(dead > 0, inside - inside.clamp(-dead, dead), inside)
    return driven * (-slip * driven.abs()).exp()


def shaped_slope(unit: Tensor, shape: Tensor) -> Tensor:
    r"""Return :math:`\psi'(u)` ``(*B, A)`` of :func:`shaped`; at kinks that of the inner side.

    >>> shaped_slope(torch.tensor([0.5, -2.0]), torch.tensor([0.25, 1.0, 0.0]))
    tensor([1., 0.])
    """
    dead, limit, slip = shape.unsqueeze(-2).unbind(-1)
    size = unit.abs() - dead
    # A dead zone that is none has no inside: the slope at u = 0 is 1.
    moves = (unit.abs() <= limit) & ((size > 0) | (dead == 0))
    return torch.where(moves, (-slip * size).exp() * (1 - slip * size), 0.0)
