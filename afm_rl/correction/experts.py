"""Least-squares experts: what simple maps make of a set of pairs (executed, effective action)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.compiling.tracing import cached
from afm_rl.correction.achievable import LIMIT, saturate
from afm_rl.correction.linear import PRIOR, fit_affine, invert_affine, not_zero, solve_line

STUCK = 5e-3  # half ranges: an action with less effect is held by friction
NOISE = 0.1  # half ranges: a pair with this standard deviation counts half
OUTLIER = 0.1  # half ranges: a residual of this size halves a pair's weight in the robust fit
EXACT = 0.02  # half ranges: a fit that misses by less explains all rows
LEAST_ROWS = 3.0  # weight of the rows that can tell which command drives an axis
LEAST_MISS = 1e-3  # half ranges: smaller residuals are all the same
NEAR = 0.15  # half ranges: a pair so far from the question counts half as much
SHORT, LONG = 0.5, 0.9  # forgetting per row
EXPERTS = 6
ANSWERS = EXPERTS + 1  # the experts' answers, and the effect or nearness of the nearest pairs
MISSES = EXPERTS - 1  # the nearest pairs have no residual of their own


class Rows(NamedTuple):
    """Pairs that describe a regime, oldest first, in half ranges."""

    executed: Tensor
    """Executed actions u, ``(*B, K, A)``."""
    effective: Tensor
    """Their effective actions, ``(*B, K, A)``."""
    std: Tensor
    """Standard deviation of the effective actions, ``(*B, K, A)``."""
    valid: Tensor
    """Which rows count, ``(*B, K, 1)``, 0 or 1."""


class Experts(NamedTuple):
    """Five least-squares fits of N sets of rows, and the rows themselves, axis by axis.

    Gains with short and with long memory; robust gain and offset; gain and friction; an affine
    map, with one command only where that explains an axis (swapped cables); and, for what none of
    them expresses, a kernel average of the nearest pairs.

    >>> u = torch.tensor([[[0.5], [-1.0]]])
    >>> experts = fit_experts(Rows(u, -2 * u, torch.zeros(1, 2, 1), torch.ones(1, 2, 1)))
    >>> experts.execute(torch.tensor([[[0.4]]]), "clip")[..., :4].round(decimals=2)
    tensor([[[[-0.2000, -0.2000, -0.2000, -0.2000]]]])
    >>> experts.effect(torch.tensor([[[0.4]]]))[..., :2].round(decimals=2)
    tensor([[[[-0.8000, -0.8000]]]])
    """

    gain: Tensor
    """Gains of the first four fits, ``(N, A, 1, 4)``."""
    offset: Tensor
    """Their offsets; the last one's is against the motion, ``(N, A, 1, 4)``."""
    matrix: Tensor
    """Of the affine map, ``(N, A, A)``."""
    bias: Tensor
    """Of the affine map, ``(N, A, 1)``."""
    residuals: Tensor
    """What each fit leaves of each row, ``(N, A, K, 5)``."""
    misses: Tensor
    """Logarithm of their root mean squares, ``(N, A, 1, 5)``."""
    executed: Tensor
    """The rows' executed actions, ``(N, A, 1, K)``."""
    effective: Tensor
    """Their effective actions, ``(N, A, 1, K)``."""
    trust: Tensor
    """Logarithm of their weights, ``(N, A, 1, K)``."""

    def execute(self, planned: Tensor, mode: str) -> Tensor:
        """Return answers ``(N, A, C, 7)`` to plans ``(N, C, A)``.

        The action that each of the five fits would execute, saturated; the kernel average of the
        actions whose effects came nearest to the plan, and that effect.
        """
        plan = planned.mT
        unit = plan.unsqueeze(-1)
        linear = (unit - self.offset[..., :3]) / self.gain[..., :3]
        rubbed = invert_friction(self.gain[..., 3:], self.offset[..., 3:], unit)
        affine = invert_affine(self.matrix, self.bias, plan).unsqueeze(-1)
        exact = saturate(torch.cat([linear, rubbed, affine], -1), mode, dim=-3)
        share = self._likeness(self.effective, unit).softmax(-1)
        pairs = torch.cat([self.executed, self.effective], -2).mT
        return torch.cat([exact, share @ pairs], -1)

    def effect(self, executed: Tensor) -> Tensor:
        """Return answers ``(N, A, C, 7)`` about actions ``(N, C, A)``.

        The effect that each of the five fits predicts, the kernel average of the effects of the
        nearest actions, and how near those are.
        """
        actions = executed.mT
        unit = actions.unsqueeze(-1)
        likeness = self._likeness(self.executed, unit)
        nearest = likeness.softmax(-1) @ self.effective.mT
        nearness = likeness.exp().sum(-1, keepdim=True).clamp_max(1.0)
        answers = torch.cat([*self.predict(actions), nearest, nearness], -1)
        return answers.clamp(-LIMIT, LIMIT)

    def predict(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the fits predict of actions ``(N, A, C)``: ``(N, A, C, 5)`` in parts."""
        unit = actions.unsqueeze(-1)
        linear = self.gain[..., :3] * unit + self.offset[..., :3]
        rubbed = apply_friction(self.gain[..., 3:], self.offset[..., 3:], unit)
        return linear, rubbed, (self.matrix @ actions + self.bias).unsqueeze(-1)

    def _likeness(self, among: Tensor, unit: Tensor) -> Tensor:
        """Return the log-weight of each row for ``unit`` ``(N, A, C, 1)``, ``(N, A, C, K)``."""
        return self.trust - ((among - unit) / NEAR).square()


def fit_experts(rows: Rows) -> Experts:
    """Fit all experts to N sets of rows ``(N, K, A)``.

    In double precision, but for the answer: where all actions are alike, gain and friction can
    hardly be told apart. The fits per axis share one product of weights and terms.
    """
    inputs, valid = rows.executed.double(), rows.valid.double().mT
    u, e = inputs.mT, rows.effective.double().mT  # (N, A, K)
    count, axes, length = u.shape
    ages, prior = _constants(length, u.device)
    weights = ages * (valid * confidence(rows.std.double().mT)).unsqueeze(-2)  # (N, A, 2, K)
    long = weights[..., 1, :]
    moved = (long * (e.abs() > STUCK)).unsqueeze(-2)
    sign = u.sign()
    each = [u * u, u * e, u, torch.ones_like(u), e, sign * u, sign * sign, sign * e]
    terms = torch.stack(each, -1).flatten(0, 1)  # (N A, K, 8)
    flat = torch.cat([weights, moved], -2).flatten(0, 1)  # (N A, 3, K)
    moments = torch.baddbmm(prior, flat, terms)
    gains = moments[:, :2, 1] / moments[:, :2, 0]
    # Of two lines: one has an offset, the other's is against the motion.
    square, cross, rest = moments[:, 1:].split([1, 1, 6], -1)
    mean, mass, shift = rest.unflatten(-1, (2, 3)).diagonal(0, 1, 2).unbind(1)
    slopes, offsets = solve_line(square[..., 0], mean, mass, cross[..., 0], shift)
    miss = e.flatten(0, 1) - torch.addcmul(offsets[:, :1], slopes[:, :1], u.flatten(0, 1))
    robust = flat[:, 1] / (1 + (miss / OUTLIER).square())
    robust = torch.baddbmm(prior[:, :5], robust.unsqueeze(1), terms[..., :5])
    square, cross, mean, mass, shift = robust.unbind(-1)
    slope, offset = solve_line(square, mean, mass, cross, shift)
    gain = not_zero(torch.cat([gains, slope, slopes[:, 1:]], -1))
    offset = torch.cat([torch.zeros_like(gains), offset, offsets[:, 1:]], -1)
    matrix, bias = fit_affine(inputs, e.mT, long.mT)
    explained, driver, shift = _drivers(u, e, long)
    matrix = torch.where(explained, driver, matrix)
    bias = torch.where(explained, shift, bias.unsqueeze(-1))
    wide = (count, axes, 1)
    experts = Experts(
        gain.unflatten(0, wide[:2]).unsqueeze(-2),
        offset.unflatten(0, wide[:2]).unsqueeze(-2),
        matrix,
        bias,
        bias,  # until the residuals are known
        bias,
        u.unsqueeze(-2),
        e.unsqueeze(-2),
        long.clamp_min(LEAST_MISS**2).log().unsqueeze(-2),
    )
    residuals = e.unsqueeze(-1) - torch.cat(experts.predict(u), -1)  # (N, A, K, 5)
    mass = weights.sum(-1, keepdim=True).clamp_min(LEAST_MISS)
    left = weights @ residuals.square() / mass
    left = torch.cat([left[..., :1, :1], left[..., 1:, 1:]], -1)
    experts = experts._replace(residuals=residuals, misses=(left.sqrt() + LEAST_MISS).log())
    return Experts(*(part.to(rows.executed) for part in experts))


def _drivers(u: Tensor, e: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Fit every effect to the one command that drives it: swapped cables need no more.

    Of many axes an affine map needs many rows, and a gait that repeats itself shows only a few.

    Args:
        u: executed actions, ``(N, A, K)``.
        e: effective actions.
        weight: of both.

    Returns:
        Which axes are explained by one command, ``(N, A, 1)``, their rows of the affine map's
        matrix, ``(N, A, A)``, and of its offset, ``(N, A, 1)``.
    """
    own = torch.eye(u.shape[-2], device=u.device, dtype=u.dtype)
    pull = weight * e
    square, mean = (weight @ torch.cat([u * u, u], -2).mT).chunk(2, -1)
    square, cross = square + PRIOR, pull @ u.mT + PRIOR * own
    mass, shift = weight.sum(-1, keepdim=True) + 10 * PRIOR, pull.sum(-1, keepdim=True)
    slope, offset = solve_line(square, mean, mass, cross, shift)
    left = (pull * e).sum(-1, keepdim=True) - slope * cross - offset * shift
    # An axis that its own command explains is driven by it, whatever else fits by chance.
    left, driver = (left.abs() / mass - EXACT**2 * own).min(-1, keepdim=True)
    limit = torch.where(own.bool(), 0.0, EXACT**2).expand_as(slope).gather(-1, driver)
    explained = (left < limit) & (mass > LEAST_ROWS)
    chosen = torch.zeros_like(slope).scatter(-1, driver, slope.gather(-1, driver))
    return explained, chosen, offset.gather(-1, driver)


@cached(maxsize=16)
def _constants(rows: int, device: torch.device) -> tuple[Tensor, ...]:
    """Return the weights by age, ``(2, K)``, and the moments of the prior, ``(1, 8)``."""
    age = torch.arange(rows - 1, -1, -1, dtype=torch.float64, device=device)
    moment = torch.arange(8, device=device).unsqueeze(0)
    slope, mass = moment < 2, (moment == 3) | (moment == 6)
    prior = PRIOR * (slope.double() + 10 * mass.double())  # written so that it can be exported
    return torch.stack([SHORT**age, LONG**age]), prior


def confidence(std: Tensor) -> Tensor:
    r"""Return the weight of effective actions by their noise, :math:`1 / (1 + (s / 0.1)^2)`.

    >>> confidence(torch.tensor([0.0, 0.1, 4.0]))
    tensor([1.0000e+00, 5.0000e-01, 6.2461e-04])
    """
    return (1 + (std / NOISE).square()).reciprocal()


def apply_friction(gain: Tensor, offset: Tensor, unit: Tensor) -> Tensor:
    r"""Return the effect of ``unit`` ``(*B, A)`` under dry friction or a dead zone.

    .. math:: v = g u + h\,\mathrm{sign}(u)

    and 0 where that is held, against the motion.

    >>> apply_friction(torch.tensor(1.0), torch.tensor(-0.5), torch.tensor([-0.75, 0.25])).tolist()
    [-0.25, 0.0]
    """
    pull = gain * unit
    effect = pull + offset * unit.sign()
    return torch.where(effect * pull < 0, 0.0, effect)


def invert_friction(gain: Tensor, offset: Tensor, unit: Tensor) -> Tensor:
    """Return the action ``(*B, A)`` that has the effect ``unit`` under :func:`apply_friction`."""
    ratio = unit / gain
    return ratio - offset / gain * ratio.sign()
