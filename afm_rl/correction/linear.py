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
    quadratic,
    solve_line,
    variance_of_line,
)
from afm_rl.spaces.small_matrices import add_diagonal, invert_positive

EXACT = 0.02  # a fit that misses by less explains all rows
LEAST_ROWS = 3.0  # weight of the rows that can tell which command drives an axis
WINDOWS = (1, 3, 12, 0)  # rows; 0: all
RIDGE = 0.01  # rows that say b = 1 and a = c = d = 0: four numbers are many for a few noisy rows


class Lines(NamedTuple):
    r"""L linear models of B missions, :math:`T(u) = D u + b`, shares of the largest action.

    How unsure a fit is of the effect of an action says Bayesian linear regression,
    :math:`x^T (X^T W X + \rho)^{-1} x` in units of the noise: of a model of one axis
    :math:`c_0 + c_1 u + c_2 u^2`. The last three mix axes; of swapped ones nothing is fitted.
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
        inputs = torch.nn.functional.pad(actions, (0, 1), value=1.0)
        affine = ((inputs @ self.leverage) * inputs).sum(-1, keepdim=True).expand_as(actions)
        driven = actions.square() @ self.driver.mT
        driven = torch.where(driven > 0, driven, affine)
        mixing = torch.stack([affine, driven, torch.zeros_like(driven)], 1)
        return torch.cat([c0 + u * (c1 + u * c2), mixing], 1)

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
        weight: of the rows, ``(B, M, A)``.
        noise: standard deviation that no model explains, ``(B, A)``.

    >>> u = torch.tensor([[[0.5], [-1.0], [0.2]]])
    >>> lines = fit_lines(u, u, 0.1 - 2 * u, torch.ones(1, 3, 1))
    >>> lines.effect(torch.ones(1, 1, 1))[0, 5].round(decimals=2)  # a line through twelve rows
    tensor([[-1.9000]])
    """
    sent, u, v, weight = (x.mT.double() for x in (sent, acted, came, weight))  # (B, A, M)
    newest = _windows(u.shape[-1], u.device) * weight.unsqueeze(-2)
    square, mean, mass, cross, shift = moments_of(newest, u, v)  # (B, A, W)
    gain, offset = not_zero(cross / square), (shift - mean) / mass
    slope, rest = solve_line(square, mean, mass, cross, shift)
    gain_12 = gain[..., 2:3]
    drift = (shift - gain_12 * mean)[..., :1] / mass[..., :1]
    arx, goes_on, arx_spread = _autoregressive(u, v, weight)
    one, none = torch.ones_like(arx), torch.zeros_like(gain)
    gains = torch.cat([-one, one, one, gain[..., 1::2], slope[..., 2:], gain_12, arx, one], -1)
    trend = _extrapolate(v - u, weight)
    biases = [none[..., :1], offset[..., :2], none[..., :2], rest[..., 2:], drift, goes_on, trend]
    affine, shift = fit_affine(sent.mT, v.mT, weight.mT)
    exact = torch.as_tensor(noise).to(v).clamp_min(EXACT).square().unsqueeze(-1)
    driven, rest, driver = _driven(sent, v, weight, exact, affine, shift.unsqueeze(-1))
    mixing = torch.stack([affine, driven, _swapped(sent, v, weight, exact)], 1)
    matrix = torch.cat([torch.diag_embed(gains.mT), mixing], 1)
    bias = torch.cat([*biases, shift.unsqueeze(-1), rest, none[..., :1]], -1).mT
    constant, slopes = quadratic(1 / mass, 0), quadratic(1 / square, 2)  # (B, A, W, 3)
    spreads = [
        quadratic(none[..., :1], 0),  # reversed: there is nothing that could be unsure
        constant[..., :2, :],
        slopes[..., 1::2, :],
        variance_of_line(square, mean, mass)[..., 2:, :],
        slopes[..., 2:3, :] + constant[..., :1, :],
        arx_spread.unsqueeze(-2),
        quadratic(5 + none[..., :1], 0),  # the trend: of two squared, and of one offset
    ]
    spread = torch.cat(spreads, -2).permute(0, 2, 3, 1)
    inputs = torch.nn.functional.pad(sent.mT, (0, 1), value=1.0)
    rows = weight.mean(1).unsqueeze(-1) * inputs
    leverage = invert_positive(add_diagonal(rows.mT @ inputs, PRIOR))
    return Lines(*(x.to(came) for x in (matrix, bias, spread, leverage, driver)))


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


def _autoregressive(u: Tensor, v: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""Return gain and offset ``(B, A, 1)`` of :math:`v_k = b u_k + c u_{k-1} + a v_{k-1} + d`.

    And the variance of v_k as a polynomial of u_k, ``(B, A, 3)``, in units of the noise.

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
    covariance = invert_positive(left)
    b, from_before, d = (covariance @ right).split([1, 2, 1], -2)  # (B, A, ., 1)
    goes_on = before[..., -1:, :] @ from_before
    rest = torch.nn.functional.pad(before[..., -1, :], (0, 1), value=1.0).unsqueeze(-1)
    shared = covariance[..., 1:, :] * rest  # (B, A, 3, 4)
    c0 = (shared[..., 1:] * rest.mT).sum((-2, -1))
    spread = torch.stack([c0, 2 * shared[..., 0].sum(-1), covariance[..., 0, 0]], -1)
    return not_zero(1 + b).squeeze(-1), (goes_on + d).squeeze(-1), spread


def _extrapolate(offset: Tensor, weight: Tensor) -> Tensor:
    r"""Return the next offset ``(B, A, 1)`` of a disturbance that goes on as it changes.

    .. math:: d_{k+1} = c\,d_k - d_{k-1},\qquad c = 2 \cos \omega

    is a line (c = 2) or an oscillation; c is fitted to the newest rows of ``(B, A, M)``. The newest
    offset where the one before it does not count, zero where neither does; at most half of the
    largest action: what is larger is a fault.
    """
    counts = (weight > 0).to(offset)
    offset = offset * counts
    before, now, after = (offset[..., k : k - 2 or None] for k in range(3))
    every = counts[..., :-2] * counts[..., 1:-1] * counts[..., 2:]
    pull = every * now * 0.95 ** torch.arange(every.shape[-1] - 1, -1, -1, device=every.device)
    c = (pull * (before + after)).sum(-1, keepdim=True) + 2 * PRIOR
    c = (c / ((pull * now).sum(-1, keepdim=True) + PRIOR)).clamp(-2, 2)
    before, newest = offset[..., -2:].split(1, -1)
    both = counts[..., -2:].prod(-1, keepdim=True)
    return (newest + both * ((c - 1) * newest - before)).clamp(-0.5, 0.5)


def _driven(
    u: Tensor, v: Tensor, weight: Tensor, exact: Tensor, else_matrix: Tensor, else_bias: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return matrix ``(B, A, A)`` and offset ``(B, A, 1)`` of axes that another command drives.

    And what the square of each command adds to the variance of an axis, ``(B, A, A)``.

    Of many axes an affine map needs many rows, and a gait that repeats itself shows only a few; but
    swapped cables need no more than gains. It stands where one explains all rows.

    Args:
        u: executed actions, ``(B, A, K)``.
        v: effects.
        weight: of both.
        exact: mean square of what a fit that explains all rows may leave, ``(B, A, 1)``.
        else_matrix: of the axes that are not explained, ``(B, A, A)``.
        else_bias: likewise, ``(B, A, 1)``.
    """
    other = 1 - torch.eye(u.shape[-2], device=u.device, dtype=u.dtype)
    pull, mass = weight * v, weight.sum(-1, keepdim=True)
    cross = pull @ u.mT + PRIOR * (1 - other)
    square = weight @ u.square().mT + PRIOR
    gain = cross / square
    left = ((pull * v).sum(-1, keepdim=True) - gain * cross) / (mass + PRIOR)
    # An axis that its own command explains is driven by it, whatever else fits by chance.
    left, driver = (left + exact * other).min(-1, keepdim=True)
    swapped = other.expand_as(gain).gather(-1, driver) > 0
    explained = swapped & (left < 2 * exact) & (mass > LEAST_ROWS)
    nothing = torch.zeros_like(gain)
    chosen = nothing.scatter(-1, driver, gain.gather(-1, driver))
    variance = nothing.scatter(-1, driver, explained / square.gather(-1, driver))
    matrix = torch.where(explained, chosen, else_matrix)
    return matrix, torch.where(explained, 0.0, else_bias), variance


def _swapped(u: Tensor, v: Tensor, weight: Tensor, exact: Tensor) -> Tensor:
    """Return the matrix ``(B, A, A)`` of axes of which two may have each other's command.

    Which two, the fewest of all rows tell: both have to do what the other one is commanded.

    Args:
        u: executed actions, ``(B, A, K)``.
        v: effects.
        weight: of both.
        exact: mean square of what a model that explains all rows may leave, ``(B, A, 1)``.
    """
    size, mass = u.shape[-2], weight.sum(-1, keepdim=True) + PRIOR
    own = torch.eye(size, device=u.device, dtype=u.dtype)
    cross = weight @ u.square().mT - 2 * (weight * v) @ u.mT
    miss = ((weight * v.square()).sum(-1, keepdim=True) + cross) / mass + exact * (1 - own)
    partner = (miss + miss.mT).argmin(-1)
    axis = torch.arange(size, device=u.device)
    partner = torch.where(partner.gather(-1, partner) == axis, partner, axis)
    return torch.zeros_like(miss).scatter(-1, partner.unsqueeze(-1), 1.0)
