"""Least-squares experts: what simple maps make of a set of pairs (executed, effective action)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.compiling.tracing import cached
from afm_rl.correction.achievable import LIMIT, saturate
from afm_rl.correction.least_squares import (
    FIXED,
    OF_OFFSET,
    PRIOR,
    downweigh,
    not_zero,
    regress,
    variance_of_line,
    with_offset,
)

NOISE = 0.1  # shares of the largest action: a pair with this standard deviation counts half
LEAST_MISS = 1e-3  # shares of the largest action: smaller residuals are all the same
NEAR = 0.15  # shares: a pair so far from the question counts half as much
SHORT, LONG = 0.5, 0.9  # forgetting per row
EXPERTS = 4
ANSWERS = EXPERTS + 1  # the experts' answers, and the effect or nearness of the nearest pairs
MISSES = EXPERTS - 1  # the nearest pairs have no residual of their own


class Rows(NamedTuple):
    """Pairs that describe a regime, oldest first, in shares of the largest action."""

    executed: Tensor
    """Executed actions u, ``(*B, K, A)``."""
    effective: Tensor
    """Their effective actions, ``(*B, K, A)``."""
    std: Tensor
    """Standard deviation of the effective actions, ``(*B, K, A)``."""
    valid: Tensor
    """Which rows count, ``(*B, K, 1)``, 0 or 1."""


class Experts(NamedTuple):
    """Three least-squares fits of N sets of rows, and the rows themselves, axis by axis.

    Gains with short and with long memory; robust gain and offset; and, for what none of them
    expresses, a kernel average of the nearest pairs.

    >>> u = torch.tensor([[[0.5], [-1.0]]])
    >>> experts = fit_experts(Rows(u, -2 * u, torch.zeros(1, 2, 1), torch.ones(1, 2, 1)))
    >>> experts.execute(torch.tensor([[[0.4]]]), "clip")[..., :3].round(decimals=2)
    tensor([[[[-0.2000, -0.2000, -0.2000]]]])
    >>> experts.effect(torch.tensor([[[0.4]]]))[..., :2].round(decimals=2)
    tensor([[[[-0.8000, -0.8000]]]])
    """

    gain: Tensor
    """Of the three fits, ``(N, A, 1, 3)``."""
    offset: Tensor
    """Of them, ``(N, A, 1, 3)``."""
    residuals: Tensor
    """What each fit leaves of each row, ``(N, A, K, 3)``."""
    misses: Tensor
    """Logarithm of their root mean squares, ``(N, A, 1, 3)``."""
    executed: Tensor
    """The rows' executed actions, ``(N, A, 1, K)``."""
    effective: Tensor
    """Their effective actions, ``(N, A, 1, K)``."""
    trust: Tensor
    """Logarithm of their weights, ``(N, A, 1, K)``."""
    covariance: Tensor
    """Of offset and gain of each fit, in units of the noise, ``(N, A, 3, 2, 2)``."""

    def execute(self, planned: Tensor, mode: str) -> Tensor:
        """Return answers ``(N, A, C, 5)`` to plans ``(N, C, A)``.

        The action that each of the fits would execute, saturated; the kernel average of the actions
        whose effects came nearest to the plan, and that effect.
        """
        unit = planned.mT.unsqueeze(-1)
        exact = saturate((unit - self.offset) / self.gain, mode, dim=-3)
        share = self._likeness(self.effective, unit).softmax(-1)
        pairs = torch.cat([self.executed, self.effective], -2).mT
        return torch.cat([exact, share @ pairs], -1)

    def effect(self, executed: Tensor) -> Tensor:
        """Return answers ``(N, A, C, 5)`` about actions ``(N, C, A)``.

        The effect that each of the fits predicts, the kernel average of the effects of the nearest
        actions, and how near those are.
        """
        unit = executed.mT.unsqueeze(-1)
        likeness = self._likeness(self.executed, unit)
        nearest = likeness.softmax(-1) @ self.effective.mT
        nearness = likeness.exp().sum(-1, keepdim=True).clamp_max(1.0)
        fits = self.gain * unit + self.offset
        return torch.cat([fits, nearest, nearness], -1).clamp(-LIMIT, LIMIT)

    def variance(self, executed: Tensor, nearness: Tensor) -> Tensor:
        """Return the variances ``(N, A, C, 4)`` of answers about actions ``(N, C, A)``.

        In units of the noise; of the nearest pairs, as if one were so near, ``(N, A, C, 1)``.
        """
        of_fits = variance_of_line(self.covariance.unsqueeze(2), executed.mT.unsqueeze(-1))
        return torch.cat([of_fits, 1 / nearness.clamp_min(LEAST_MISS)], -1)

    def _likeness(self, among: Tensor, unit: Tensor) -> Tensor:
        """Return the log-weight of each row for ``unit`` ``(N, A, C, 1)``, ``(N, A, C, K)``."""
        return self.trust - ((among - unit) / NEAR).square()


def fit_experts(rows: Rows) -> Experts:
    """Fit all experts to N sets of rows ``(N, K, A)``, in double precision but for the answer."""
    u, e, std, valid = (part.double().mT for part in rows)  # (N, A, K)
    weights = _ages(u.shape[-1], u.device) * (valid * confidence(std)).unsqueeze(-2)
    inputs, left, precision = with_offset(u), (e - u).unsqueeze(-2), _priors(u.device)
    fits = regress(inputs, left, weights, precision)  # two gains, a line
    misses = left - fits.coefficients[..., MISSES - 1 :, :] @ inputs.mT
    robust = downweigh(weights[..., MISSES - 1 :, :], misses)
    line = regress(inputs, left, robust, precision[MISSES - 1 :])
    coefficients, covariance = (
        torch.cat([of_all[:, :, : MISSES - 1], of_line], 2)
        for of_all, of_line in zip(fits, line, strict=True)
    )
    offset, gain = coefficients.unsqueeze(-3).unbind(-1)  # (N, A, 1, 3)
    gain = not_zero(1 + gain)
    residuals = e.unsqueeze(-1) - gain * u.unsqueeze(-1) - offset
    total = weights.sum(-1).clamp_min(LEAST_MISS)
    misses = ((weights * residuals.square().mT).sum(-1) / total).unsqueeze(-2)
    misses = (misses.sqrt() + LEAST_MISS).log()
    trust = weights[..., MISSES - 1 :, :].clamp_min(LEAST_MISS**2).log()
    gain, offset, residuals, misses, trust, covariance = (
        part.to(rows.executed) for part in (gain, offset, residuals, misses, trust, covariance)
    )
    executed, effective = (part.mT.unsqueeze(-2) for part in rows[:2])
    return Experts(gain, offset, residuals, misses, executed, effective, trust, covariance)


@cached(maxsize=16)
def _ages(rows: int, device: torch.device) -> Tensor:
    """Return the weights by age of the three fits, ``(3, K)``."""
    age = torch.arange(rows - 1, -1, -1, dtype=torch.float64, device=device)
    return torch.stack([SHORT**age, LONG**age, LONG**age])


@cached(maxsize=16)
def _priors(device: torch.device) -> Tensor:
    """Return the precisions of offset and gain of the three fits, ``(3, 2)``."""
    is_line = (torch.arange(MISSES, device=device) == MISSES - 1).double()
    offset = FIXED * (1 - is_line) + OF_OFFSET * is_line
    return torch.stack([offset, torch.full_like(offset, PRIOR)], -1)


def confidence(std: Tensor) -> Tensor:
    r"""Return the weight of effective actions by their noise, :math:`1 / (1 + (s / 0.1)^2)`.

    >>> confidence(torch.tensor([0.0, 0.1, 4.0]))
    tensor([1.0000e+00, 5.0000e-01, 6.2461e-04])
    """
    return (1 + (std / NOISE).square()).reciprocal()
