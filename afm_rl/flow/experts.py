"""Least-squares experts: what simple maps make of a set of pairs (executed, effective action)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.flow.saturation import LIMIT, saturate

STUCK = 5e-3  # half ranges: an action with less effect is held by friction
PRIOR = 1e-4  # weight of the nominal map in every fit
LEAST_GAIN = 0.02  # smallest gain that is divided by
NOISE = 0.1  # half ranges: a pair with this standard deviation counts half
LEAST_MISS = 1e-3  # half ranges: smaller residuals are all the same
NEAR = 0.15  # half ranges: a pair so far from the question counts half as much
SHORT, LONG = 0.5, 0.9  # forgetting per row
OUTLIER = 0.1  # half ranges: a residual of this size halves a pair's weight in the robust fit
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


def weigh(valid: Tensor, forgetting: float) -> Tensor:
    r"""Return the weight of each row ``(*B, K, 1)``: :math:`\lambda^k` at age k, if it counts.

    >>> weigh(torch.ones(3, 1), 0.5).squeeze(-1)
    tensor([0.2500, 0.5000, 1.0000])
    """
    age = torch.arange(valid.shape[-2] - 1, -1, -1, device=valid.device, dtype=valid.dtype)
    return valid * (forgetting**age).unsqueeze(-1)


def confidence(std: Tensor) -> Tensor:
    r"""Return the weight of effective actions by their noise, :math:`1 / (1 + (s / 0.1)^2)`.

    >>> confidence(torch.tensor([0.0, 0.1, 4.0]))
    tensor([1.0000e+00, 5.0000e-01, 6.2461e-04])
    """
    return (1 + (std / NOISE).square()).reciprocal()


def fit_gain(executed: Tensor, effective: Tensor, weight: Tensor) -> Tensor:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u`, each axis for itself, with a weak prior g = 1.

    .. math:: g = \frac{\sum_k w_k u_k u_{\mathrm{eff},k} + \rho}{\sum_k w_k u_k^2 + \rho}

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes, ``(*B, K, A)``.

    Returns:
        Gains ``(*B, A)``, none smaller than 0.02 in size.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> fit_gain(u, -2 * u, weigh(torch.ones(2, 1), 0.8)).round(decimals=2)
    tensor([-2.])
    """
    pull = weight * executed
    cross = (pull * effective).sum(-2) + PRIOR
    return _not_zero(cross / ((pull * executed).sum(-2) + PRIOR))


def fit_gain_offset(
    executed: Tensor, effective: Tensor, weight: Tensor, rounds: int = 2
) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u + b` robustly, each axis for itself.

    Iteratively reweighted least squares with Cauchy weights
    :math:`1 / (1 + (r / 0.1)^2)` of the residuals r, and a weak prior g = 1, b = 0.

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs and axes, ``(*B, K, A)``.
        rounds: times that the weights are renewed.

    Returns:
        Gains, none smaller than 0.02 in size, and offsets, ``(*B, A)`` each.

    >>> u = torch.tensor([[0.5], [-1.0], [0.2]])
    >>> gain, offset = fit_gain_offset(u, 0.5 * u + 0.1, torch.ones(3, 1))
    >>> gain.round(decimals=2), offset.round(decimals=2)
    (tensor([0.5000]), tensor([0.1000]))
    """
    ones = torch.ones_like(executed)
    terms = torch.stack([executed * executed, executed, ones, executed * effective, effective], -4)
    robust = weight
    for turn in range(rounds + 1):
        square, mean, mass, cross, shift = (terms * robust.unsqueeze(-4)).sum(-2).unbind(-3)
        square, mass, cross = square + PRIOR, mass + 10 * PRIOR, cross + PRIOR
        determinant = (square * mass - mean.square()).clamp_min(PRIOR**2)
        gain = (mass * cross - mean * shift) / determinant
        offset = (square * shift - mean * cross) / determinant
        if turn < rounds:
            miss = effective - (gain.unsqueeze(-2) * executed + offset.unsqueeze(-2))
            robust = weight / (1 + (miss / OUTLIER).square())
    return _not_zero(gain), offset


def fit_friction(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u + h \odot \mathrm{sign}(u)`, each axis for itself.

    Dry friction, or a dead zone: pairs without any effect are left out, see
    :func:`apply_friction`. Weak prior g = 1, h = 0. Args as for :func:`fit_gain`.

    Returns:
        Gains, none smaller than 0.02 in size, and offsets, ``(*B, A)`` each.
    """
    size, sign = executed.abs(), executed.sign()
    terms = torch.stack([size * size, size, sign.abs(), executed * effective, sign * effective], -4)
    moved = weight * (effective.abs() > STUCK)
    square, mixed, signs, cross, signed = (moved.unsqueeze(-4) * terms).sum(-2).unbind(-3)
    square, cross, signs = square + PRIOR, cross + PRIOR, signs + 10 * PRIOR
    determinant = (square * signs - mixed.square()).clamp_min(PRIOR**2)
    gain = (signs * cross - mixed * signed) / determinant
    return _not_zero(gain), (square * signed - mixed * cross) / determinant


def apply_friction(gain: Tensor, offset: Tensor, unit: Tensor) -> Tensor:
    """Return the effect of ``unit`` ``(*B, A)`` under :func:`fit_friction`: zero if it is held.

    >>> apply_friction(torch.tensor(1.0), torch.tensor(-0.5), torch.tensor([-0.75, 0.25])).tolist()
    [-0.25, 0.0]
    """
    pull = gain * unit
    effect = pull + offset * unit.sign()
    return torch.where(effect * pull < 0, 0.0, effect)


def invert_friction(gain: Tensor, offset: Tensor, unit: Tensor) -> Tensor:
    """Return the action ``(*B, A)`` that has the effect ``unit`` under :func:`fit_friction`."""
    ratio = unit / gain
    return ratio - offset / gain * ratio.sign()


def fit_affine(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = D u + b` with a weak prior D = 1, b = 0.

    Args as for :func:`fit_gain`; with weights per axis every row of D has its own.

    Returns:
        D ``(*B, A, A)`` and b ``(*B, A)``.
    """
    size = executed.shape[-1]
    inputs = torch.nn.functional.pad(executed, (0, 1), value=1.0)
    nominal = torch.eye(size + 1, device=inputs.device, dtype=inputs.dtype)
    if weight.shape[-1] == 1:
        moments = (weight * inputs).mT @ torch.cat([inputs, effective], -1)
        moments = moments + PRIOR * torch.cat([nominal, nominal[:, :-1]], -1)
        solution = torch.linalg.solve(moments[..., : size + 1], moments[..., size + 1 :]).mT
        return solution[..., :-1], solution[..., -1]
    outer = (inputs.unsqueeze(-1) * inputs.unsqueeze(-2)).flatten(-2)  # (*B, K, (A + 1)^2)
    square = (weight.mT @ outer).unflatten(-1, (size + 1, size + 1)) + PRIOR * nominal
    cross = (weight * effective).mT @ inputs + PRIOR * nominal[:-1]
    solution = torch.linalg.solve(square, cross)
    return solution[..., :-1], solution[..., -1]


def invert_affine(matrix: Tensor, bias: Tensor, unit: Tensor) -> Tensor:
    """Return the action ``(*B, A)`` whose effect under :func:`fit_affine` is nearest to ``unit``.

    A small ridge keeps it finite where the matrix is all but singular.
    """
    ridge = LEAST_GAIN**2 * torch.eye(unit.shape[-1], device=unit.device, dtype=unit.dtype)
    target = (matrix * (unit - bias).unsqueeze(-1)).sum(-2, keepdim=True).mT
    return torch.linalg.solve(matrix.mT @ matrix + ridge, target).squeeze(-1)


def _not_zero(gain: Tensor) -> Tensor:
    return gain.abs().clamp_min(LEAST_GAIN).copysign(gain)


class Experts(NamedTuple):
    """Five least-squares fits of a set of rows, and the rows themselves.

    Gains with short and with long memory; robust gain and offset; gain and friction; an affine
    map; and, for what none of them expresses, a kernel average of the nearest pairs.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> experts = fit_experts(Rows(u, -2 * u, torch.zeros(2, 1), torch.ones(2, 1)))
    >>> experts.execute(torch.tensor([0.4]), 1)[..., :4].round(decimals=2)
    tensor([[-0.2000, -0.2000, -0.2000, -0.2000]])
    >>> experts.effect(torch.tensor([0.4]))[..., :2].round(decimals=2)
    tensor([[-0.8000, -0.8000]])
    """

    gain: Tensor
    """Gains of the first three experts, ``(*B, 3, A)``."""
    offset: Tensor
    """Their offsets, ``(*B, 3, A)``."""
    friction: Tensor
    """Gain and offset against the motion, ``(*B, 2, A)``."""
    matrix: Tensor
    """Of the affine map, ``(*B, A, A)``."""
    inverse: Tensor
    """Its regularised inverse, ``(*B, A, A)``."""
    bias: Tensor
    """Of the affine map, ``(*B, A)``."""
    residuals: Tensor
    """What each fit leaves of each row, ``(*B, K, A, 5)``."""
    misses: Tensor
    """Logarithm of their root mean squares, ``(*B, A, 5)``."""
    executed: Tensor
    """The rows' executed actions, ``(*B, K, A)``."""
    effective: Tensor
    """Their effective actions, ``(*B, K, A)``."""
    trust: Tensor
    """Logarithm of their weights, ``(*B, K, A)``."""

    def execute(self, planned: Tensor, mode: str) -> Tensor:
        """Return answers ``(*B, C, A, 7)`` to plans ``(*B, C, A)``.

        The action that each of the five fits would execute, saturated; the kernel average of the
        actions whose effects came nearest to the plan, and that effect.
        """
        kind, planned = planned.dtype, planned.to(self.bias.dtype)
        unit = planned.unsqueeze(-2)
        linear = (unit - self.offset.unsqueeze(-3)) / self.gain.unsqueeze(-3)
        gain, offset = self.friction.unsqueeze(-3).split(1, -2)
        rubbed = invert_friction(gain, offset, unit)
        affine = (planned - self.bias.unsqueeze(-2)) @ self.inverse.mT
        exact = saturate(torch.cat([linear, rubbed, affine.unsqueeze(-2)], -2), mode)
        share = self._likeness(self.effective, unit).softmax(-2).unsqueeze(-3)
        pairs = torch.stack([self.executed, self.effective], -3).unsqueeze(-4)
        return torch.cat([exact, (share * pairs).sum(-2)], -2).mT.to(kind)

    def effect(self, executed: Tensor) -> Tensor:
        """Return answers ``(*B, C, A, 7)`` about actions ``(*B, C, A)``.

        The effect that each of the five fits expects, the kernel average of the effects of the
        nearest actions, and how near those are.
        """
        kind, executed = executed.dtype, executed.to(self.bias.dtype)
        unit = executed.unsqueeze(-2)
        likeness = self._likeness(self.executed, unit)
        nearest = (likeness.softmax(-2) * self.effective.unsqueeze(-3)).sum(-2, keepdim=True)
        nearness = likeness.exp().sum(-2, keepdim=True).clamp_max(1.0)
        answers = [*self._expected(executed), nearest, nearness]
        return torch.cat(answers, -2).clamp(-LIMIT, LIMIT).mT.to(kind)

    def _expected(self, executed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the fits expect of actions ``(*B, C, A)``, ``(*B, C, 5, A)`` in parts."""
        unit = executed.unsqueeze(-2)
        linear = self.gain.unsqueeze(-3) * unit + self.offset.unsqueeze(-3)
        gain, offset = self.friction.unsqueeze(-3).split(1, -2)
        rubbed = apply_friction(gain, offset, unit)
        affine = executed @ self.matrix.mT + self.bias.unsqueeze(-2)
        return linear, rubbed, affine.unsqueeze(-2)

    def _likeness(self, among: Tensor, unit: Tensor) -> Tensor:
        """Return the log-weight of each row for ``unit`` ``(*B, C, 1, A)``, ``(*B, C, K, A)``."""
        return self.trust.unsqueeze(-3) - ((among.unsqueeze(-3) - unit) / NEAR).square()


def fit_experts(rows: Rows) -> Experts:
    """Fit all experts to rows ``(*B, K, A)``.

    In double precision: where all actions are alike, gain and friction can hardly be told apart.
    The fits per axis share one product of weights and terms; they are those of :func:`fit_gain`,
    :func:`fit_gain_offset` with one round, :func:`fit_friction` and :func:`fit_affine`.
    """
    executed, effective, std, valid = (part.double() for part in rows)
    ages, prior = _constants(executed.shape[-2])
    weights = ages * (valid * confidence(std)).unsqueeze(-3)  # short and long, (*B, 2, K, A)
    long = weights[..., 1, :, :]
    moved = long * (effective.abs() > STUCK)
    squares, crosses = executed * executed, executed * effective
    sign = executed.sign()
    terms = [squares, executed, sign * sign, crosses, effective, sign * executed, sign * effective]
    terms = torch.stack([*terms, torch.ones_like(sign)], -1).transpose(-2, -3)  # (*B, A, K, 8)
    weights = torch.cat([weights, moved.unsqueeze(-3)], -3).movedim(-1, -3)  # (*B, A, 3, K)
    moments = weights @ terms + prior
    gains = moments[..., :2, 3] / moments[..., :2, 0]  # (*B, A, 2)
    both = moments[..., PLACES[0], PLACES[1]]  # long with offset, moved with friction
    slopes, offsets = _solve_line(both)
    miss = effective - (slopes[..., 0].unsqueeze(-2) * executed + offsets[..., 0].unsqueeze(-2))
    robust = (long / (1 + (miss / OUTLIER).square())).mT.unsqueeze(-2)  # (*B, A, 1, K)
    robust = (robust @ terms + prior[1])[..., PLACES[1][0]]
    slope, offset = _solve_line(robust)
    matrix, bias = fit_affine(executed, effective, long)
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    inverse = torch.linalg.solve(matrix.mT @ matrix + LEAST_GAIN**2 * eye, matrix.mT)
    gain = _not_zero(torch.cat([gains, slope, slopes[..., 1:]], -1)).mT
    offset = torch.cat([torch.zeros_like(gains), offset], -1).mT
    friction = torch.stack([gain[..., 3, :], offsets[..., 1]], -2)
    experts = Experts(
        gain[..., :3, :],
        offset,
        friction,
        matrix,
        inverse,
        bias,
        bias,  # until the residuals are known
        bias,
        executed,
        effective,
        long.clamp_min(LEAST_MISS**2).log(),
    )
    expected = torch.cat(experts._expected(executed), -2)
    residuals = (effective.unsqueeze(-2) - expected).mT  # (*B, K, A, 5)
    weights = weights[..., :2, :]
    mass = weights.sum(-1, keepdim=True).clamp_min(LEAST_MISS)
    left = weights @ residuals.square().transpose(-2, -3) / mass
    left = torch.cat([left[..., 0, :1], left[..., 1, 1:]], -1)
    return experts._replace(residuals=residuals, misses=(left.sqrt() + LEAST_MISS).log())


PLACES = torch.tensor([[1], [2]]), torch.tensor([[0, 1, 7, 3, 4], [0, 5, 2, 3, 6]])
"""Rows and columns of the moments of the two lines that are fitted with an offset."""


def _solve_line(moments: Tensor) -> tuple[Tensor, Tensor]:
    """Return slope and offset ``(*B)`` of weighted least squares, given its moments ``(*B, 5)``."""
    square, mean, mass, cross, shift = moments.unbind(-1)
    determinant = (square * mass - mean * mean).clamp_min(PRIOR**2)
    slope = (mass * cross - mean * shift) / determinant
    return slope, (square * shift - mean * cross) / determinant


@lru_cache(maxsize=16)
def _constants(rows: int) -> tuple[Tensor, Tensor]:
    """Return the weights by age ``(2, K, 1)`` and the prior's moments ``(3, 8)``."""
    age = torch.arange(rows - 1, -1, -1, dtype=torch.float64)
    ages = torch.stack([SHORT**age, LONG**age]).unsqueeze(-1)
    prior = torch.zeros(3, 8, dtype=torch.float64)
    prior[:, [0, 3]], prior[:, [2, 7]] = PRIOR, 10 * PRIOR
    return ages, prior
