"""Linear models of the actuators, from the newest few pairs to all that are remembered.

Two rows may tell a sign, but in noise it takes many; so the belief has windows of several lengths.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.compiling.tracing import cached
from afm_rl.correction.least_squares import (
    PRIOR,
    fit_affine,
    invert_affine,
    moments_of,
    not_zero,
    solve_line,
    variance_of_line,
)
from afm_rl.spaces.small_matrices import add_diagonal, invert_positive

EXACT = 0.02  # a fit that misses by less explains all rows
LEAST_ROWS = 3.0  # weight of the rows that can tell which command drives an axis
WINDOWS = (1, 3, 12, 0)  # rows; 0: all
MIXING = 3  # models that mix axes, the last ones
RIDGE = 0.01  # rows that say b = 1 and a = c = d = 0: four numbers are many for a few noisy rows


class Lines(NamedTuple):
    r"""L linear models of B missions, :math:`T(u) = D u + b`, shares of the largest action.

    The variance of a predicted effect is that of Bayesian linear regression, in units of the noise
    :math:`x^T (X^T W X + \rho)^{-1} x`; of a model of one axis it is
    :math:`c_0 + c_1 u + c_2 u^2`. The last three models mix axes; of swapped axes nothing is
    fitted.
    """

    matrix: Tensor
    """D, ``(B, L, A, A)``."""
    bias: Tensor
    """b, ``(B, L, A)``."""
    spread: Tensor
    """c of those of one axis, ``(B, L - 3, 3, A)``."""
    leverage: Tensor
    """:math:`(X^T W X + \rho)^{-1}` of the affine map, x = (u, 1), ``(B, A + 1, A + 1)``."""
    driver: Tensor
    """The same of a gain, where the command of another axis drives one, else 0, ``(B, A, A)``."""

    def variance(self, actions: Tensor) -> Tensor:
        """Return the variances ``(B, L, C, A)`` of the effects of actions ``(B, C, A)``."""
        u = actions.unsqueeze(1)
        c0, c1, c2 = self.spread.unsqueeze(3).unbind(2)
        return torch.cat([c0 + u * (c1 + u * c2), self.mixing(actions)[1]], 1)

    def mixing(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return effects and variances of actions ``(B, C, A)``, ``(B, 3, C, A)`` each.

        By the models that mix axes.
        """
        matrix, bias = self.matrix[:, -MIXING:], self.bias[:, -MIXING:]
        effect = actions.unsqueeze(1) @ matrix.mT + bias.unsqueeze(2)
        inputs = torch.nn.functional.pad(actions, (0, 1), value=1.0)
        affine = ((inputs @ self.leverage) * inputs).sum(-1, keepdim=True).expand_as(actions)
        driven = actions.square() @ self.driver.mT
        driven = torch.where(driven > 0, driven, affine)
        return effect, torch.stack([affine, driven, torch.zeros_like(driven)], 1)

    def effect(self, actions: Tensor) -> Tensor:
        """Return the effects ``(B, L, C, A)`` of actions ``(B, C, A)``, or ``(B, L, C, A)``."""
        actions = actions if actions.dim() == 4 else actions.unsqueeze(1)
        return actions @ self.matrix.mT + self.bias.unsqueeze(2)

    def invert(self, planned: Tensor) -> Tensor:
        """Return the actions ``(B, L, A)`` whose effects come nearest to plans ``(B, A)``."""
        plan = planned[:, None, :, None]
        return invert_affine(self.matrix, self.bias.unsqueeze(-1), plan).squeeze(-1)


def fit_lines(
    sent: Tensor, acted: Tensor, came: Tensor, weight: Tensor, noise: Tensor | float = EXACT
) -> Lines:
    r"""Fit all linear :data:`~afm_rl.correction.hypotheses.HYPOTHESES`, in their order.

    By least squares, with a weak prior D = 1, b = 0.

    Args:
        sent: commands, the oldest first, ``(B, M, A)``; what mixes axes is fitted to them.
        acted: those that acted, if they act late; the others are fitted to them.
        came: the effects.
        weight: of the rows, ``(B, M, A)`` or ``(B, M, 1)``.
        noise: standard deviation that no model explains, ``(B, A)``.

    >>> u = torch.tensor([[[0.5], [-1.0], [0.2]]])
    >>> lines = fit_lines(u, u, 0.1 - 2 * u, torch.ones(1, 3, 1))
    >>> lines.effect(torch.ones(1, 1, 1))[0, 5].round(decimals=2)  # a line through twelve rows
    tensor([[-1.9000]])
    """
    sent, u, v, weight = (x.mT.double() for x in (sent, acted, came, weight))  # (B, A, M)
    newest = _windows(u.shape[-1], u.device) * weight.unsqueeze(-2)
    square, mean, mass, cross, shift = moments_of(newest, u, v)  # (B, A, W)
    one, none = torch.ones_like(mass), torch.zeros_like(mass)
    gain, of_offset, of_gain = not_zero(cross / square), 1 / mass, 1 / square
    offset, gain_12 = (shift - mean) / mass, gain[..., 2:3]
    drift = (shift - gain_12 * mean)[..., :1] / mass[..., :1]
    line = (
        *solve_line(square, mean, mass, cross, shift),
        *variance_of_line(square, mean, mass).unbind(-1),
    )
    offsets, gains, lines = (
        torch.stack(terms, -1)  # gain, offset, and the coefficients of the variance
        for terms in ((one, offset, of_offset, none, none), (gain, none, none, none, of_gain), line)
    )
    last = [gain_12, drift, of_offset[..., :1], none[..., :1], of_gain[..., 2:3]]
    single = [
        torch.stack([-one, none, none, none, none], -1)[..., :1, :],  # reversed
        offsets[..., :2, :],
        gains[..., 1::2, :],
        lines[..., 2:, :],
        torch.stack(last, -1),
        _autoregressive(u, v, weight),
        _trend(v - u, weight),
    ]
    gains, bias, *spread = torch.cat(single, -2).transpose(1, 2).unbind(-1)  # (B, L, A)
    matrix, shift, driver = _mixing(sent, v, weight, noise)
    inputs = torch.nn.functional.pad(sent.mT, (0, 1), value=1.0)
    rows = weight.mean(1).unsqueeze(-1) * inputs
    leverage = invert_positive(add_diagonal(rows.mT @ inputs, PRIOR))
    matrix = torch.cat([torch.diag_embed(gains), matrix], 1)
    bias = torch.cat([bias, shift], 1)
    return Lines(*(x.to(came) for x in (matrix, bias, torch.stack(spread, 2), leverage, driver)))


@cached(maxsize=16)
def _windows(length: int, device: torch.device) -> Tensor:
    """Return which rows are in each window, ``(W, M)``."""
    age = torch.arange(length - 1, -1, -1, device=device)
    return torch.stack([age < (rows or length) for rows in WINDOWS]).double()


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


def at_rest(
    acts: Tensor, sent: Tensor, came: Tensor, valid: Tensor, rows: int = 20, widest: float = 0.2
) -> Tensor:
    """Return the next effect ``(B, 1, A)`` of actuators that stick.

    One that rests does so until a command is farther from it than any at which it rested before, of
    the newest ``rows``; then it does as commanded.

    Args:
        acts: the command that acts now, ``(B, 1, A)``.
        sent: commands that acted, the oldest first, ``(B, M, A)``.
        came: their effects.
        valid: which rows count, ``(B, M, 1)``, 0 or 1.
        widest: band within which actuators may stick.

    >>> sent, rests = torch.full((1, 3, 1), 0.1), torch.zeros(1, 3, 1)
    >>> acts = torch.tensor([[[0.05, 0.3]]])
    >>> at_rest(acts, sent, rests, torch.ones(1, 3, 1)).flatten()
    tensor([0.0000, 0.3000])
    """
    sent, came, valid = (rows_of[:, -rows:] for rows_of in (sent, came, valid))
    rests = valid[:, 1:] * valid[:, :-1] * (came.diff(dim=1).abs() < EXACT / 4)
    band = (rests * (sent - came).abs()[:, 1:]).amax(1, keepdim=True).clamp_max(widest)
    now = came[:, -1:]
    return torch.where((acts - now).abs() <= 1.05 * band, now, acts)


def _autoregressive(u: Tensor, v: Tensor, weight: Tensor) -> Tensor:
    r"""Return the line in u_k that is :math:`v_k = b u_k + c u_{k-1} + a v_{k-1} + d`.

    The row before is known. Gain, offset, and the coefficients of the variance, ``(B, A, 1, 5)``.
    A row after one that does not count does not count either.

    Args:
        u: executed, the oldest first, ``(B, A, M)``.
        v: effects.
        weight: of the rows.
    """
    sound = (weight > 0).to(u)
    before = torch.stack([u * sound, v * sound, torch.ones_like(u)], -1)
    x = torch.cat([before[..., :-1, :], u[..., 1:].unsqueeze(-1)], -1)
    pull = (weight[..., 1:] * sound[..., :-1]).unsqueeze(-1) * x
    covariance = invert_positive(add_diagonal(pull.mT @ x, RIDGE))
    fit = covariance @ (pull.mT @ (v - u)[..., 1:].unsqueeze(-1))  # (B, A, 4, 1)
    # The inputs of the next row are (0, rest) + u_k (1, 0).
    rest = torch.nn.functional.pad(before[..., -1:, :], (0, 1))
    ends = torch.cat([rest, torch.eye(4).to(u)[3:].expand_as(rest)], -2)
    (offset, gain), spread = (ends @ fit).squeeze(-1).unbind(-1), ends @ covariance @ ends.mT
    c0, c1, c2 = spread[..., 0, 0], 2 * spread[..., 0, 1], spread[..., 1, 1]
    return torch.stack([not_zero(1 + gain), offset, c0, c1, c2], -1).unsqueeze(-2)


def _trend(offset: Tensor, weight: Tensor) -> Tensor:
    r"""Return the line of a gain of one and a disturbance that goes on as it changes.

    .. math:: d_{k+1} = c\,d_k - d_{k-1},\qquad c = 2 \cos \omega

    is a line (c = 2) or an oscillation; c is fitted to the newest rows of ``(B, A, M)``. The newest
    offset where the one before it does not count, zero where neither does; at most half of the
    largest action: what is larger is a fault. The variance is that of two squared, and of one.
    """
    counts = (weight > 0).to(offset)
    offset = offset * counts
    before, now, after = (offset[..., k : k - 2 or None] for k in range(3))
    pull = now * counts[..., :-2] * counts[..., 2:] * _newest(now.shape[-1], now.device)
    c = (pull * (before + after)).sum(-1) + 2 * PRIOR
    c = (c / ((pull * now).sum(-1) + PRIOR)).clamp(-2, 2)
    before, newest = offset[..., -2], offset[..., -1]
    both = counts[..., -2] * counts[..., -1]
    goes_on = (newest + both * ((c - 1) * newest - before)).clamp(-0.5, 0.5)
    one, none = torch.ones_like(c), torch.zeros_like(c)
    return torch.stack([one, goes_on, 5 * one, none, none], -1).unsqueeze(-2)


@cached(maxsize=16)
def _newest(length: int, device: torch.device) -> Tensor:
    """Return weights that halve in some fourteen rows, ``(M,)``."""
    return 0.95 ** torch.arange(length - 1, -1, -1, dtype=torch.float64, device=device)


def _mixing(
    u: Tensor, v: Tensor, weight: Tensor, noise: Tensor | float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the models that mix axes: matrices ``(B, 3, A, A)``, and offsets ``(B, 3, A)``.

    And what the square of each command adds to the variance of an axis that it drives,
    ``(B, A, A)``. An affine map; the same, but for axes that another command drives; and two axes
    that have each other's command.

    Args:
        u: executed actions, ``(B, A, K)``.
        v: effects.
        weight: of both.
        noise: standard deviation that no model explains, ``(B, A)``.
    """
    affine, shift = fit_affine(u.mT, v.mT, weight.mT)
    own = torch.eye(u.shape[-2], device=u.device, dtype=u.dtype)
    # Mean square of what a model that explains all rows may leave. An axis that its own command
    # explains is driven by it, whatever else fits by chance.
    exact = torch.as_tensor(noise).to(v).clamp_min(EXACT).square().unsqueeze(-1)
    fair = exact * (1 - own)
    pull, mass = weight * v, weight.sum(-1, keepdim=True)
    cross, square = pull @ u.mT, weight @ u.square().mT
    total, count = (pull * v).sum(-1, keepdim=True), mass + PRIOR
    gain, square = (cross + PRIOR * own) / (square + PRIOR), square + PRIOR
    # Of many axes an affine map needs many rows, and a gait that repeats itself shows only a few;
    # but swapped cables need no more than gains.
    left, driver = ((total - gain * cross) / count + fair).min(-1, keepdim=True)
    explained = (
        (left < 2 * exact) & (mass > LEAST_ROWS) & (own.expand_as(gain).gather(-1, driver) == 0)
    )
    nothing = torch.zeros_like(gain)
    driven = nothing.scatter(-1, driver, gain.gather(-1, driver))
    variance = nothing.scatter(-1, driver, explained / square.gather(-1, driver))
    # Which two are swapped, the fewest of all rows tell: both do what the other one is commanded.
    miss = (total + square - 2 * cross) / count + fair
    partner = (miss + miss.mT).argmin(-1)
    axis = torch.arange(u.shape[-2], device=u.device)
    partner = torch.where(partner.gather(-1, partner) == axis, partner, axis)
    swapped = nothing.scatter(-1, partner.unsqueeze(-1), 1.0)
    matrix = torch.stack([affine, torch.where(explained, driven, affine), swapped], 1)
    none = torch.zeros_like(shift)
    driven_shift = torch.where(explained.squeeze(-1), none, shift)
    return matrix, torch.stack([shift, driven_shift, none], 1), variance
