"""Linear models of the actuators: lines, an axis for itself, and maps that mix axes.

Each is one function of the evidence. Two rows may tell a sign, but in noise it takes many; so there
are several.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.compiling.tracing import cached
from afm_rl.correction.least_squares import (
    LEAST_GAIN,
    PRIOR,
    fit_affine,
    fit_gain,
    invert_affine,
    prior_of_line,
    regress,
    variance_of_line,
    with_offset,
)


class Evidence(NamedTuple):
    """What is remembered of B missions, the oldest row first, in shares of the largest action."""

    sent: Tensor
    """Commands, ``(B, A, M)``."""
    acted: Tensor
    """Those that acted, if they act as late as is believed, ``(B, A, M)``."""
    effect: Tensor
    """What they did, ``(B, A, M)``."""
    weight: Tensor
    """Of the rows, by how sure their effects are; zero where one does not count, ``(B, A, M)``."""
    noise: Tensor
    """Standard deviation that no model explains, ``(B, A)``."""


class Line(NamedTuple):
    r"""L lines of B missions, :math:`T(u) = g u + b`, each axis for itself.

    The variance of a predicted effect is that of Bayesian linear regression, in units of the noise.
    """

    gain: Tensor
    """g, ``(B, L, A)``; of a single line ``(B, A)``."""
    offset: Tensor
    """b, likewise."""
    covariance: Tensor
    """Of offset and gain, ``(B, L, A, 2, 2)``."""

    def effect(self, actions: Tensor) -> Tensor:
        """Return the effects ``(B, L, C, A)`` of actions ``(B, L, C, A)``, or ``(B, 1, C, A)``."""
        return self.gain.unsqueeze(2) * actions + self.offset.unsqueeze(2)

    def variance(self, actions: Tensor) -> Tensor:
        """Return the variances ``(B, L, C, A)`` of the effects of actions ``(B, C, A)``."""
        return variance_of_line(self.covariance.unsqueeze(2), actions.unsqueeze(1))

    def invert(self, planned: Tensor) -> Tensor:
        """Return the actions ``(B, L, A)`` whose effects come nearest to plans ``(B, A)``."""
        left = planned.unsqueeze(1) - self.offset
        return self.gain * left / (self.gain.square() + LEAST_GAIN**2)


class Map(NamedTuple):
    r"""L maps of B missions that mix axes, :math:`T(u) = D u + b`."""

    matrix: Tensor
    """D, ``(B, L, A, A)``; of a single map ``(B, A, A)``."""
    offset: Tensor
    """b, ``(B, L, A)``."""
    covariance: Tensor
    """Of each row of (D, b), ``(B, L, A, A + 1, A + 1)``."""

    def effect(self, actions: Tensor) -> Tensor:
        """Return the effects ``(B, L, C, A)`` of actions ``(B, L, C, A)``, or ``(B, 1, C, A)``."""
        return actions @ self.matrix.mT + self.offset.unsqueeze(2)

    def variance(self, actions: Tensor) -> Tensor:
        """Return the variances ``(B, L, C, A)`` of the effects of actions ``(B, C, A)``."""
        inputs = torch.nn.functional.pad(actions, (0, 1), value=1.0)[:, None, None]
        return ((inputs @ self.covariance) * inputs).sum(-1).mT

    def invert(self, planned: Tensor) -> Tensor:
        """Return the actions ``(B, L, A)`` whose effects come nearest to plans ``(B, A)``."""
        plan = planned[:, None, :, None]
        return invert_affine(self.matrix, self.offset.unsqueeze(-1), plan).squeeze(-1)


def opposite(rows: Evidence) -> Line:
    """Return the opposite of the command: it needs no fit, and says what every action does."""
    none = torch.zeros_like(rows.noise)
    return Line(none - 1, none, none.new_zeros(*none.shape, 2, 2))


def gain(rows: Evidence) -> Line:
    """Return the gain of all rows."""
    factor, variance = fit_gain(rows.acted.mT, rows.effect.mT, rows.weight.mT)
    covariance = torch.nn.functional.pad(variance[..., None, None], (1, 0, 1, 0))
    return Line(factor, torch.zeros_like(factor), covariance)


def line(rows: Evidence) -> Line:
    """Return gain and offset of all rows."""
    left, weight = (rows.effect - rows.acted).unsqueeze(-2), rows.weight.unsqueeze(-2)
    inputs = with_offset(rows.acted)
    change, covariance = regress(inputs, left, weight, prior_of_line(inputs))
    offset, gain = change.squeeze(-2).unbind(-1)
    return Line(1 + gain, offset, covariance.squeeze(-3))


def trend(rows: Evidence) -> Line:
    r"""Return a gain of one, and the next offset of a disturbance that goes on as it changes.

    .. math:: d_{k+1} = c\,d_k - d_{k-1},\qquad c = 2 \cos \omega

    is a line (c = 2) or an oscillation; c is fitted to the newest rows. The newest offset where the
    one before it does not count, zero where neither does; at most half of the largest action: what
    is larger is a fault. The variance is that of two offsets squared, and of one. For commands that
    are one sine, a disturbance, a delay and a gain look the same, and this does no harm.
    """
    counts = (rows.weight > 0).to(rows.effect)
    offset = (rows.effect - rows.acted) * counts
    before, now, after = (offset[..., k : k - 2 or None] for k in range(3))
    pull = now * counts[..., :-2] * counts[..., 2:] * _newest(now.shape[-1], now.device)
    c = (pull * (before + after)).sum(-1) + 2 * PRIOR
    c = (c / ((pull * now).sum(-1) + PRIOR)).clamp(-2, 2)
    before, newest = offset[..., -2], offset[..., -1]
    both = counts[..., -2] * counts[..., -1]
    goes_on = (newest + both * ((c - 1) * newest - before)).clamp(-0.5, 0.5)
    five = torch.full_like(goes_on, 5.0)[..., None, None]
    return Line(torch.ones_like(goes_on), goes_on, torch.nn.functional.pad(five, (0, 1, 0, 1)))


@cached(maxsize=16)
def _newest(length: int, device: torch.device) -> Tensor:
    """Return weights that halve in some fourteen rows, ``(M,)``."""
    return 0.95 ** torch.arange(length - 1, -1, -1, dtype=torch.float64, device=device)


def affine(rows: Evidence) -> Map:
    """Return the affine map of all rows."""
    return Map(*fit_affine(rows.sent.mT, rows.effect.mT, rows.weight.mT))


def swapped(rows: Evidence) -> Map:
    """Return the map by which two axes have each other's command.

    Which two, the fewest of all rows tell: both do what the other one is commanded.
    """
    pull = rows.weight * rows.effect
    cross, total = pull @ rows.sent.mT, (pull * rows.effect).sum(-1, keepdim=True)
    left = total + rows.weight @ rows.sent.square().mT - 2 * cross
    axis = torch.arange(cross.shape[-1], device=cross.device)
    partner = (left + left.mT).argmin(-1)
    partner = torch.where(partner.gather(-1, partner) == axis, partner, axis)
    matrix, size = (partner.unsqueeze(-1) == axis).to(cross), len(axis) + 1
    none = torch.zeros_like(rows.noise)
    return Map(matrix, none, none.new_zeros(*none.shape, size, size))
