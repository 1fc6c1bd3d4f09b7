"""Linear models of the actuators, from the newest few pairs to all that are remembered.

Two rows may tell a sign, but in noise it takes many; so the belief has windows of several lengths.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.correction.fits import LEAST_GAIN, PRIOR, not_zero, solve_line
from afm_rl.spaces.small_matrices import solve_positive

LINEAR = (
    "reversed",
    "offset_1",
    "offset_3",
    "gain_3",
    "gain_12",
    "gain",
    "line_12",
    "line",
    "drift",
    "arx",
    "affine",
)
"""The opposite of the command; offset at a gain of one; gain; gain and offset (*line*); gain and the newest offset (*drift*);
what goes on from row to row (*arx*); affine map. Of the newest rows, or of all pairs."""
CALM = ("only so fast", "noisy readings")
"""Models by which there is nothing to correct: :func:`within_rate`, and :func:`sensor_noise`."""
WINDOWS = (1, 3, 12, 0)  # rows; 0: all
RIDGE = 0.01  # rows that say b = 1 and a = c = d = 0: four numbers are many for a few noisy rows


class Lines(NamedTuple):
    """L linear models of B missions, :math:`T(u) = D u + b`, shares of the largest action."""

    matrix: Tensor
    """D, ``(B, L, A, A)``."""
    bias: Tensor
    """b, ``(B, L, A)``."""

    def effect(self, actions: Tensor) -> Tensor:
        """Return the effects ``(B, L, C, A)`` of actions ``(B, C, A)``."""
        return actions.unsqueeze(1) @ self.matrix.mT + self.bias.unsqueeze(2)

    def invert(self, planned: Tensor) -> Tensor:
        """Return the actions ``(B, L, A)`` whose effects come nearest to plans ``(B, A)``."""
        eye = torch.eye(planned.shape[-1], device=planned.device, dtype=planned.dtype)
        ridge = self.matrix.mT @ self.matrix + LEAST_GAIN**2 * eye
        pull = self.matrix.mT @ (planned.unsqueeze(1) - self.bias).unsqueeze(-1)
        return solve_positive(ridge, pull).squeeze(-1)


def fit_lines(sent: Tensor, came: Tensor, std: Tensor, valid: Tensor) -> Lines:
    r"""Fit all :data:`LINEAR` models by least squares, with a weak prior D = 1, b = 0.

    Args:
        sent: executed actions, the oldest first, ``(B, M, A)``.
        came: their effects.
        std: of the effects; a row counts by :math:`1 / \sigma^2`.
        valid: which rows count, ``(B, M, 1)``, 0 or 1.

    >>> u = torch.tensor([[[0.5], [-1.0], [0.2]]])
    >>> lines = fit_lines(u, 0.1 - 2 * u, torch.full((1, 3, 1), 0.02), torch.ones(1, 3, 1))
    >>> lines.effect(torch.ones(1, 1, 1))[0, LINEAR.index("line_12")].round(decimals=2)
    tensor([[-1.9000]])
    """
    size, length = sent.shape[-1], sent.shape[-2]
    weight = valid * (std.square() + PRIOR).reciprocal()
    scale = weight.amax(-2, keepdim=True).clamp_min(PRIOR)
    u, v, weight = (part.mT.double() for part in (sent, came, weight / scale))  # (B, A, M)
    age = torch.arange(length - 1, -1, -1, device=sent.device)
    newest = torch.stack([age < (rows or length) for rows in WINDOWS]).to(u)
    ones = torch.ones_like(u)
    terms = torch.stack([u * u, u, ones, u * v, v], -1)  # (B, A, M, 5)
    moments = (newest * weight.unsqueeze(-2)) @ terms  # (B, A, W, 5)
    square, mean, mass, cross, shift = moments.unbind(-1)
    square, mass, cross = square + PRIOR, mass + 10 * PRIOR, cross + PRIOR
    gain = not_zero(cross / square)
    offset = (shift - mean) / mass
    slope, rest = solve_line(square, mean, mass, cross, shift)
    zero, one = torch.zeros_like(gain[..., 0]), torch.ones_like(gain[..., 0])
    drift = (shift - gain[..., 2:3] * mean)[..., 0] / mass[..., 0]
    gains = [-one, one, one, gain[..., 1], gain[..., 2], gain[..., 3], slope[..., 2], slope[..., 3]]
    biases = [zero, offset[..., 0], offset[..., 1], zero, zero, zero, rest[..., 2], rest[..., 3]]
    slope, rest = _autoregressive(u, v, weight)
    gains, biases = [*gains, gain[..., 2], slope], [*biases, drift, rest]
    matrix = torch.diag_embed(torch.stack(gains, 1))  # (B, L - 1, A, A)
    outer = torch.nn.functional.pad(u.mT, (0, 1), value=1.0)  # (B, M, A + 1)
    nominal = PRIOR * torch.eye(size + 1, device=sent.device, dtype=u.dtype)
    pairs = (outer.unsqueeze(-1) * outer.unsqueeze(-2)).flatten(-2)
    left = (weight @ pairs).unflatten(-1, (size + 1, size + 1)) + nominal
    right = (weight * v) @ outer + nominal[:-1]
    solution = solve_positive(left, right.unsqueeze(-1)).squeeze(-1)  # (B, A, A + 1)
    matrix = torch.cat([matrix, solution[:, None, :, :-1]], 1)
    bias = torch.cat([torch.stack(biases, 1), solution[:, None, :, -1]], 1)
    return Lines(matrix.to(sent), bias.to(sent))


def sensor_noise(sent: Tensor, came: Tensor, valid: Tensor, keep: float = 0.7) -> Tensor:
    r"""Return what errors of the readings add to the next effect, ``(B, 1, A)``.

    An error n of a reading is in two effects, :math:`v_k = u_k + n_{k+1} - n_k`. A policy answers
    it, too, so it looks like another gain. Exponential smoothing of the misses foresees it
    (Muth 1960): :math:`-\sum_j \theta^j (v_{k-j} - u_{k-j})`.

    Args:
        sent: executed actions, the oldest first, ``(B, M, A)``.
        came: their effects.
        valid: which rows count, ``(B, M, 1)``, 0 or 1.
        keep: :math:`\theta`, 1 if nothing but the readings is noisy, 0 if nothing of them is.

    >>> sensor_noise(torch.zeros(1, 2, 1), torch.tensor([[[-0.4], [0.4]]]), torch.ones(1, 2, 1))
    tensor([[[-0.0840]]])
    """
    age = torch.arange(sent.shape[-2], 0, -1, device=sent.device)
    weight = valid * (keep**age).unsqueeze(-1).to(sent)
    return (weight * (sent - came)).sum(-2, keepdim=True)


def within_rate(came: Tensor, valid: Tensor, rows: int = 12, least: float = 0.05) -> Tensor:
    """Return the lowest and highest next effect ``(B, 2, A)`` of actuators with a limited rate.

    That is the fastest of the newest ``rows``, and no less than ``least``: what does not move is
    not slow. Without two effects nothing is limited.

    Args:
        came: effects, the oldest first, ``(B, M, A)``.
        valid: which rows count, ``(B, M, 1)``, 0 or 1.

    >>> within_rate(torch.tensor([[[0.0], [0.2], [0.3]]]), torch.ones(1, 3, 1)).flatten()
    tensor([0.1000, 0.5000])
    """
    came, valid = came[:, -rows:], valid[:, -rows:]
    both = valid[:, 1:] * valid[:, :-1]
    rate = (both * came.diff(dim=1).abs()).amax(1, keepdim=True).clamp_min(least)
    known = both[:, -1:] > 0
    now = came[:, -1:]
    return torch.cat([torch.where(known, now + k * rate, k * torch.inf) for k in (-1, 1)], 1)


def _autoregressive(u: Tensor, v: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return gain and offset ``(B, A)`` of :math:`v_k = b u_k + c u_{k-1} + a v_{k-1} + d`.

    The row before is known, so this is a line in u. Rows after one that does not count do not.

    Args:
        u: executed, the oldest first, ``(B, A, M)``.
        v: effects.
        weight: of the rows.
    """
    sound = (weight > 0).to(u)
    before = torch.stack([u, v], -1) * sound.unsqueeze(-1)
    x = torch.cat([u.unsqueeze(-1), before.roll(1, -2), torch.ones_like(u).unsqueeze(-1)], -1)
    follows = sound.roll(1, -1) * (torch.arange(u.shape[-1], device=u.device) > 0)
    pull = (weight * follows).unsqueeze(-1) * x
    left = pull.mT @ x + RIDGE * torch.eye(4, device=u.device, dtype=u.dtype)
    right = pull.mT @ (v - u).unsqueeze(-1)
    b, c, a, d = solve_positive(left, right).squeeze(-1).unbind(-1)
    last_u, last_v = before[..., -1, :].unbind(-1)
    return not_zero(1 + b), c * last_u + a * last_v + d
