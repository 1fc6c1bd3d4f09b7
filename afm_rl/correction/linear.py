"""Linear models of the actuators, from the newest few pairs to all that are remembered.

Two rows may tell a sign, but in noise it takes many; so the belief has windows of several lengths.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.compiling.tracing import cached
from afm_rl.spaces.small_matrices import add_diagonal, solve_positive

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
"""The opposite of the command; offset at a gain of one; gain; gain and offset (*line*); gain and
the newest offset (*drift*); what goes on from row to row (*arx*); affine map. Of the newest rows,
or of all pairs."""
CALM = ("only so fast", "noisy readings")
"""Models by which there is nothing to correct: :func:`within_rate`, and :func:`sensor_noise`."""
PRIOR = 1e-4  # weight of the nominal map in every fit
LEAST_GAIN = 0.02  # smallest gain that is divided by
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
        plan = planned[:, None, :, None]
        return invert_affine(self.matrix, self.bias.unsqueeze(-1), plan).squeeze(-1)


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
    weight = valid * (std.square() + PRIOR).reciprocal()
    scale = weight.amax(-2, keepdim=True).clamp_min(PRIOR)
    u, v, weight = (part.mT.double() for part in (sent, came, weight / scale))  # (B, A, M)
    terms = torch.stack([u * u, u, torch.ones_like(u), u * v, v], -1)  # (B, A, M, 5)
    newest, prior = _constants(u.shape[-1], u.device)
    moments = (newest * weight.unsqueeze(-2)) @ terms + prior  # (B, A, W, 5)
    square, mean, mass, cross, shift = moments.unbind(-1)
    gain, offset = not_zero(cross / square), (shift - mean) / mass
    slope, rest = solve_line(square, mean, mass, cross, shift)
    gain_12 = gain[..., 2:3]
    drift = (shift - gain_12 * mean)[..., :1] / mass[..., :1]
    arx, goes_on = _autoregressive(u, v, weight)
    one, none = torch.ones_like(arx), torch.zeros_like(gain)
    gains = torch.cat([-one, one, one, gain[..., 1:], slope[..., 2:], gain_12, arx], -1)
    biases = [none[..., :1], offset[..., :2], none[..., 1:], rest[..., 2:], drift, goes_on]
    affine, shift = fit_affine(u.mT, v.mT, weight.mT)
    matrix = torch.cat([torch.diag_embed(gains.mT), affine.unsqueeze(1)], 1)
    bias = torch.cat([*biases, shift.unsqueeze(-1)], -1).mT
    return Lines(matrix.to(sent), bias.to(sent))


@cached(maxsize=16)
def _constants(length: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return which rows are in each window, ``(W, M)``, and the moments of the prior, ``(5,)``."""
    age = torch.arange(length - 1, -1, -1, device=device)
    moment = torch.arange(5, device=device)
    slope, mass = (moment == 0) | (moment == 3), moment == 2
    prior = PRIOR * (slope.double() + 10 * mass.double())  # written so that it can be exported
    return torch.stack([age < (rows or length) for rows in WINDOWS]).double(), prior


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
    r"""Return gain and offset ``(B, A, 1)`` of :math:`v_k = b u_k + c u_{k-1} + a v_{k-1} + d`.

    The row before is known, so this is a line in u. Rows after one that does not count do not.

    Args:
        u: executed, the oldest first, ``(B, A, M)``.
        v: effects.
        weight: of the rows.
    """
    sound = (weight > 0).to(u)
    before = torch.stack([u * sound, v * sound], -1)
    now = u[..., 1:].unsqueeze(-1)
    x = torch.cat([now, before[..., :-1, :], torch.ones_like(now)], -1)
    pull = (weight[..., 1:] * sound[..., :-1]).unsqueeze(-1) * x
    left = add_diagonal(pull.mT @ x, RIDGE)
    right = pull.mT @ (v - u)[..., 1:].unsqueeze(-1)
    b, from_before, d = solve_positive(left, right).split([1, 2, 1], -2)  # (B, A, ., 1)
    goes_on = before[..., -1:, :] @ from_before
    return not_zero(1 + b).squeeze(-1), (goes_on + d).squeeze(-1)


def solve_line(
    square: Tensor, mean: Tensor, mass: Tensor, cross: Tensor, shift: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return slope and offset ``(*B)`` of weighted least squares, given its moments ``(*B)``.

    These are :math:`\sum w u^2`, :math:`\sum w u`, :math:`\sum w`, :math:`\sum w u v` and
    :math:`\sum w v`, with a prior, so that none vanishes.
    """
    determinant = (square * mass - mean * mean).clamp_min(PRIOR**2)
    slope = (mass * cross - mean * shift) / determinant
    return slope, (square * shift - mean * cross) / determinant


def fit_affine(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = D u + b` with a weak prior D = 1, b = 0.

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes: then every row of D has its own.

    Returns:
        D ``(*B, A, A)`` and b ``(*B, A)``.
    """
    size = executed.shape[-1]
    inputs = torch.nn.functional.pad(executed, (0, 1), value=1.0)
    outer = (inputs.unsqueeze(-1) * inputs.unsqueeze(-2)).flatten(-2)  # (*B, K, (A + 1)^2)
    square = add_diagonal((weight.mT @ outer).unflatten(-1, (size + 1, size + 1)), PRIOR)
    cross = add_diagonal((weight * effective).mT @ inputs, PRIOR)
    solution = solve_positive(square, cross.unsqueeze(-1)).squeeze(-1)
    return solution[..., :-1], solution[..., -1]


def invert_affine(matrix: Tensor, bias: Tensor, unit: Tensor) -> Tensor:
    """Return the actions ``(*B, A, C)`` whose effects come nearest to what is wanted.

    Of :func:`fit_affine`. A small ridge keeps them finite where the matrix is all but singular.

    Args:
        matrix: D, ``(*B, A, A)``.
        bias: b, ``(*B, A, 1)``.
        unit: what is wanted, ``(*B, A, C)``.
    """
    square = add_diagonal(matrix.mT @ matrix, LEAST_GAIN**2)
    return solve_positive(square, matrix.mT @ (unit - bias))


def not_zero(gain: Tensor) -> Tensor:
    """Return gains that can be divided by: none smaller than 0.02 in size."""
    return gain.abs().clamp_min(LEAST_GAIN).copysign(gain)
