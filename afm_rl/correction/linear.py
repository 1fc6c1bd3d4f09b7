"""Linear models of the actuators, from the newest few pairs to all that are remembered.

Two rows may tell a sign, but in noise it takes many; so the belief has windows of several lengths.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from afm_rl.compiling.tracing import cached
from afm_rl.correction.least_squares import (
    FIXED,
    LEAST_GAIN,
    OF_OFFSET,
    PRIOR,
    fit_affine,
    invert_affine,
    not_zero,
    regress,
    variance_of_line,
)

EXACT = 0.02  # a fit that misses by less explains all rows
LEAST_ROWS = 3.0  # weight of the rows that can tell which command drives an axis
MIXING = 3  # models that mix axes, the last ones
RIDGE = 0.01  # rows that say b = 1 and a = c = d = 0: four numbers are many for a few noisy rows


class LineFit(NamedTuple):
    r"""How a line of one axis is fitted: :math:`v_k = d + b u_k + c u_{k-1} + a v_{k-1}`.

    What is not fitted is b = 1, and a = c = d = 0.
    """

    precision: tuple[float, ...]
    """Of the priors of d, b, c and a; :data:`FIXED` where one is not fitted."""
    rows: int = 10**9
    """The newest rows; all, if there are no more."""
    newest_offset: bool = False
    """Is d what the newest row leaves?"""


OFFSET = (OF_OFFSET, FIXED, FIXED, FIXED)
GAIN = (FIXED, PRIOR, FIXED, FIXED)
LINE = (OF_OFFSET, PRIOR, FIXED, FIXED)
AUTOREGRESSIVE = (RIDGE, RIDGE, RIDGE, RIDGE)


class Lines(NamedTuple):
    r"""L linear models of B missions, :math:`T(u) = D u + b`, shares of the largest action.

    The variance of a predicted effect is that of Bayesian linear regression, in units of the noise.
    The last three models mix axes; of swapped axes nothing is fitted.
    """

    matrix: Tensor
    """D, ``(B, L, A, A)``."""
    bias: Tensor
    """b, ``(B, L, A)``."""
    covariance: Tensor
    """Of offset and gain of those of one axis, ``(B, L - 3, A, 2, 2)``."""
    affine: Tensor
    """Of a row (D, b) of the affine map, ``(B, A, A + 1, A + 1)``."""
    driver: Tensor
    """Of the gain, where the command of another axis drives one, else 0, ``(B, A, A)``."""

    def variance(self, actions: Tensor) -> Tensor:
        """Return the variances ``(B, L, C, A)`` of the effects of actions ``(B, C, A)``."""
        single = variance_of_line(self.covariance.unsqueeze(2), actions.unsqueeze(1))
        return torch.cat([single, self.mixing(actions)[1]], 1)

    def mixing(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return effects and variances of actions ``(B, C, A)``, ``(B, 3, C, A)`` each.

        By the models that mix axes.
        """
        matrix, bias = self.matrix[:, -MIXING:], self.bias[:, -MIXING:]
        effect = actions.unsqueeze(1) @ matrix.mT + bias.unsqueeze(2)
        inputs = torch.nn.functional.pad(actions, (0, 1), value=1.0).unsqueeze(1)
        affine = ((inputs @ self.affine) * inputs).sum(-1).mT
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


class LinearModels(nn.Module):
    r"""Fits all linear :data:`~afm_rl.correction.hypotheses.HYPOTHESES`, in their order.

    Lines of one axis, by one :func:`~afm_rl.correction.least_squares.regress`; the trend; and the
    models that mix axes.

    Args:
        fits: of the lines.

    >>> models, u = LinearModels([LineFit(LINE)]), torch.tensor([[[0.5], [-1.0]]])
    >>> lines = models(u, u, 0.1 - 2 * u, torch.ones(1, 2, 1))
    >>> lines.effect(torch.ones(1, 1, 1))[0, 1].round(decimals=2)  # the first is "reversed"
    tensor([[-1.9000]])
    """

    precision: Tensor
    rows: Tensor
    newest: Tensor

    def __init__(self, fits: Sequence[LineFit]) -> None:
        super().__init__()
        precision = torch.tensor([fit.precision for fit in fits], dtype=torch.float64)
        self.register_buffer("precision", precision, persistent=False)
        self.register_buffer("rows", torch.tensor([[fit.rows] for fit in fits]), persistent=False)
        newest = torch.tensor([fit.newest_offset for fit in fits])
        self.register_buffer("newest", newest, persistent=False)

    def forward(
        self,
        sent: Tensor,
        acted: Tensor,
        came: Tensor,
        weight: Tensor,
        noise: Tensor | float = EXACT,
    ) -> Lines:
        """Fit all models to rows, the oldest first.

        Args:
            sent: commands, ``(B, M, A)``; what mixes axes is fitted to them.
            acted: those that acted, if they act late; the others are fitted to them.
            came: the effects.
            weight: of the rows, ``(B, M, A)`` or ``(B, M, 1)``.
            noise: standard deviation that no model explains, ``(B, A)``.
        """
        sent, u, v, weight = (x.mT.double() for x in (sent, acted, came, weight))  # (B, A, M)
        gain, offset, covariance = self.lines(u, v, weight)
        trend, unsure = _trend(v - u, weight)
        one, none = torch.ones_like(trend), torch.zeros_like(gain[..., :1])
        gain = torch.cat([-one, gain, one], -1).mT  # (B, L, A)
        offset = torch.cat([none, offset, trend], -1).mT
        sure = torch.zeros_like(covariance[:, :, :1])
        covariance = torch.cat([sure, covariance, unsure], 2).transpose(1, 2)
        matrix, shift, affine, driver = _mixing(sent, v, weight, noise)
        matrix = torch.cat([torch.diag_embed(gain), matrix], 1)
        bias = torch.cat([offset, shift], 1)
        return Lines(*(x.to(came) for x in (matrix, bias, covariance, affine, driver)))

    def lines(self, u: Tensor, v: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Fit the lines of one axis to rows ``(B, A, M)``.

        Returns:
            Gains and offsets, ``(B, A, L)``, and their covariance, ``(B, A, L, 2, 2)``, the offset
            first: of the next effect, for which the row before it is known.
        """
        sound, offset_prior = (weight > 0).to(u), self.precision[:, 0]
        rows = torch.stack([torch.ones_like(u), u, u * sound, v * sound], -1)
        before = torch.nn.functional.pad(rows[..., 2:], (0, 0, 1, 0))  # of the next one, too
        inputs = torch.cat([rows[..., :2], before[..., :-1, :]], -1)
        # A row counts if it is of the newest, and where it goes on, if the one before it counts.
        age = torch.arange(u.shape[-1] - 1, -1, -1, device=u.device)
        after = torch.nn.functional.pad(sound[..., :-1], (1, 0)).unsqueeze(-2)
        weights = torch.where(self.precision[:, 2:3] < FIXED, after, (age < self.rows).to(u))
        fit = regress(inputs, (v - u).unsqueeze(-2), weights * weight.unsqueeze(-2), self.precision)
        # The inputs of the next row are (1, 0, before) + u (0, 1, 0, 0).
        ends = torch.nn.functional.pad(torch.eye(2).to(u), (0, 2)).expand(*u.shape[:2], 2, 4)
        ends = ends + torch.nn.functional.pad(before[..., -1:, :], (2, 0, 0, 1))
        ends = ends.unsqueeze(2)
        offset, gain = (ends @ fit.coefficients.unsqueeze(-1)).squeeze(-1).unbind(-1)
        gain = not_zero(1 + gain, LEAST_GAIN * (offset_prior != OF_OFFSET))
        mass, left = weight[..., -1:] + OF_OFFSET, v[..., -1:] - gain * u[..., -1:]
        offset = torch.where(self.newest, weight[..., -1:] * left / mass, offset)
        of_newest = torch.nn.functional.pad((self.newest / mass)[..., None, None], (0, 1, 0, 1))
        return gain, offset, ends @ fit.covariance @ ends.mT + of_newest


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


def _trend(offset: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the next offset ``(B, A, 1)`` of a disturbance that goes on as it changes.

    .. math:: d_{k+1} = c\,d_k - d_{k-1},\qquad c = 2 \cos \omega

    is a line (c = 2) or an oscillation; c is fitted to the newest rows of ``(B, A, M)``. The newest
    offset where the one before it does not count, zero where neither does; at most half of the
    largest action: what is larger is a fault. And its covariance with a gain that is certain,
    ``(B, A, 1, 2, 2)``: the variance is that of two squared, and of one.
    """
    counts = (weight > 0).to(offset)
    offset = offset * counts
    before, now, after = (offset[..., k : k - 2 or None] for k in range(3))
    pull = now * counts[..., :-2] * counts[..., 2:] * _newest(now.shape[-1], now.device)
    c = (pull * (before + after)).sum(-1) + 2 * PRIOR
    c = (c / ((pull * now).sum(-1) + PRIOR)).clamp(-2, 2)
    before, newest = offset[..., -2], offset[..., -1]
    both = counts[..., -2] * counts[..., -1]
    goes_on = (newest + both * ((c - 1) * newest - before)).clamp(-0.5, 0.5).unsqueeze(-1)
    five = torch.full_like(goes_on, 5.0)[..., None, None]
    return goes_on, torch.nn.functional.pad(five, (0, 1, 0, 1))


@cached(maxsize=16)
def _newest(length: int, device: torch.device) -> Tensor:
    """Return weights that halve in some fourteen rows, ``(M,)``."""
    return 0.95 ** torch.arange(length - 1, -1, -1, dtype=torch.float64, device=device)


def _mixing(
    u: Tensor, v: Tensor, weight: Tensor, noise: Tensor | float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the models that mix axes: matrices ``(B, 3, A, A)``, and offsets ``(B, 3, A)``.

    And the covariance of each axis of the affine map, ``(B, A, A + 1, A + 1)``, and what the square
    of each command adds to the variance of an axis that it drives, ``(B, A, A)``. An affine map;
    the same, but for axes that another command drives; and two axes that have each other's command.

    Args:
        u: executed actions, ``(B, A, K)``.
        v: effects.
        weight: of both.
        noise: standard deviation that no model explains, ``(B, A)``.
    """
    affine, shift, covariance = fit_affine(u.mT, v.mT, weight.mT)
    own = torch.eye(u.shape[-2]).to(u)
    # Mean square of what a model that explains all rows may leave. An axis that its own command
    # explains is driven by it, whatever else fits by chance.
    exact = torch.as_tensor(noise).to(v).clamp_min(EXACT).square().unsqueeze(-1)
    pull, mass = weight * v, weight.sum(-1, keepdim=True)
    cross, square = pull @ u.mT, weight @ u.square().mT + PRIOR
    total = (pull * v).sum(-1, keepdim=True)
    gain = (cross + PRIOR * own) / square
    # Of many axes an affine map needs many rows, and a gait that repeats itself shows only a few;
    # but swapped cables need no more than gains.
    left = torch.stack([total - gain * cross, total + square - 2 * cross], 1)
    left = left / (mass + PRIOR).unsqueeze(1) + (exact * (1 - own)).unsqueeze(-3)
    least, driver = left[:, 0].min(-1, keepdim=True)
    axis = torch.arange(u.shape[-2], device=u.device)
    explained = (least < 2 * exact) & (mass > LEAST_ROWS) & (driver != axis.unsqueeze(-1))
    drives = explained & (driver == axis)
    # Which two are swapped, the fewest of all rows tell: both do what the other one is commanded.
    partner = (left[:, 1] + left[:, 1].mT).argmin(-1)
    partner = torch.where(partner.gather(-1, partner) == axis, partner, axis)
    matrix = torch.stack(
        [
            affine,
            torch.where(explained, gain * drives, affine),
            (partner.unsqueeze(-1) == axis).to(u),
        ],
        1,
    )
    shift = torch.stack([shift, shift * ~explained.squeeze(-1), torch.zeros_like(shift)], 1)
    return matrix, shift, covariance, drives / square
