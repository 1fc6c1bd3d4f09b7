"""Weighted least squares, batched over models, with a prior: all fits of the correction."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.spaces.small_matrices import add_diagonal, invert_positive, solve_positive

PRIOR = 1e-4  # weight of the nominal map in every fit
OF_OFFSET = 1e-3  # weight of an offset of zero in a line
FIXED = 1e12  # weight of a coefficient that is not fitted
LEAST_GAIN = 0.02  # smallest gain that is divided by
OUTLIER = 0.1  # shares of the largest action: such a residual halves a pair's weight


class Regression(NamedTuple):
    r"""Bayesian linear regression of L models :math:`y = \theta^\top x`.

    The variance of a prediction is :math:`s^2 x^\top \Sigma x` in noise of the deviation s.
    """

    coefficients: Tensor
    r""":math:`\theta`, ``(*B, L, N)``."""
    covariance: Tensor
    r""":math:`\Sigma = (X^\top W X + \Lambda)^{-1}`, ``(*B, L, N, N)``."""


def regress(inputs: Tensor, outputs: Tensor, weights: Tensor, precision: Tensor) -> Regression:
    r"""Fit L models to one set of rows, each with its own weights of the rows, and prior.

    .. math:: \theta = (X^\top W X + \Lambda)^{-1} X^\top W y

    by one Gram matrix and one inverse of all models. A priori :math:`\theta = 0`: y is what the
    nominal map leaves, and :math:`\theta` what is to be added to it.

    Args:
        inputs: X, ``(*B, K, N)``.
        outputs: y, ``(*B, L, K)``, or ``(*B, 1, K)``: all models have the same.
        weights: W, ``(*B, L, K)``.
        precision: diagonal of :math:`\Lambda`, ``(L, N)`` or ``(N,)``; :data:`FIXED` where a
            coefficient stays 0.

    >>> x = torch.tensor([[1.0, 0.5], [1.0, -1.0], [1.0, 0.2]])
    >>> y, weights = 0.1 - 2 * x[:, 1], torch.ones(1, 3)
    >>> regress(x, y, weights, torch.full((2,), PRIOR)).coefficients.round(decimals=3)
    tensor([[ 0.1000, -2.0000]])
    """
    products = (inputs.unsqueeze(-1) * inputs.unsqueeze(-2)).flatten(-2)
    gram = (weights @ products).unflatten(-1, (inputs.shape[-1], -1))
    covariance = invert_positive(gram + torch.diag_embed(precision))
    pull = ((weights * outputs) @ inputs).unsqueeze(-1)
    return Regression((covariance @ pull).squeeze(-1), covariance)


def precision_of(std: Tensor, valid: Tensor) -> Tensor:
    r"""Return weights ``(B, M, A)`` of rows, :math:`1 / (\sigma^2 + 10^{-4})` over the best row's.

    Args:
        std: standard deviation of the effects, ``(B, M, A)``.
        valid: which rows count, ``(B, M, 1)``, 0 or 1.
    """
    weight = valid * (std.square() + PRIOR).reciprocal()
    return weight / weight.amax(-2, keepdim=True).clamp_min(PRIOR)


def fit_gain(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u`, each axis for itself, with a weak prior g = 1.

    .. math:: g = \sigma_g^2 \Big(\sum_k w_k u_k u_{\mathrm{eff},k} + \rho\Big),\qquad
              \sigma_g^{-2} = \sum_k w_k u_k^2 + \rho

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes, ``(*B, K, A)``.

    Returns:
        Gains, and their variances in units of the noise, ``(*B, A)`` each.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> fit_gain(u, -2 * u, torch.ones(2, 1))[0].round(decimals=2)
    tensor([-2.])
    """
    pull = weight * executed
    variance = ((pull * executed).sum(-2) + PRIOR).reciprocal()
    return ((pull * effective).sum(-2) + PRIOR) * variance, variance


def fit_line(
    executed: Tensor, effective: Tensor, weight: Tensor, rounds: int = 2
) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u + b` robustly, each axis for itself.

    Iteratively reweighted least squares with Cauchy weights
    :math:`1 / (1 + (r / 0.1)^2)` of the residuals r, and a weak prior g = 1, b = 0.

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes, ``(*B, K, A)``.
        rounds: times that the weights are renewed.

    Returns:
        Gains, none smaller than 0.02 in size, and offsets, ``(*B, A)`` each.

    >>> u = torch.tensor([[0.5], [-1.0], [0.2]])
    >>> gain, offset = fit_line(u, 0.5 * u + 0.1, torch.ones(3, 1))
    >>> gain.round(decimals=2), offset.round(decimals=2)
    (tensor([0.5000]), tensor([0.1000]))
    """
    inputs = with_offset(executed.mT)
    left, weight = (effective - executed).mT.unsqueeze(-2), weight.expand_as(executed).mT
    weights = robust = weight.unsqueeze(-2)  # (*B, A, 1, K)
    precision = prior_of_line(inputs)
    for _ in range(rounds):
        fit = regress(inputs, left, robust, precision).coefficients
        robust = downweigh(weights, left - fit @ inputs.mT)
    offset, gain = regress(inputs, left, robust, precision).coefficients.squeeze(-2).unbind(-1)
    return not_zero(1 + gain), offset


def with_offset(executed: Tensor) -> Tensor:
    """Return the inputs (1, u) of a line, ``(*B, K, 2)``, of commands ``(*B, K)``."""
    return torch.stack([torch.ones_like(executed), executed], -1)


def prior_of_line(like: Tensor) -> Tensor:
    """Return the precisions of offset and change of gain of a line, ``(2,)``."""
    # No constant: an exported branch may not hold one.
    return OF_OFFSET + (PRIOR - OF_OFFSET) * torch.arange(2).to(like)


def variance_of_line(covariance: Tensor, executed: Tensor) -> Tensor:
    r"""Return the variance of a line's effect, :math:`(1, u)^\top \Sigma\,(1, u)`, ``(*B)``.

    Args:
        covariance: of offset and gain, ``(*B, 2, 2)``.
        executed: u, ``(*B)``.
    """
    constant, mixed, _, square = covariance.flatten(-2).unbind(-1)
    return constant + executed * (2 * mixed + executed * square)


def downweigh(weights: Tensor, residuals: Tensor) -> Tensor:
    r"""Return Cauchy weights, :math:`w / (1 + (r / 0.1)^2)`."""
    return weights / (1 + (residuals / OUTLIER).square())


def fit_affine(
    executed: Tensor, effective: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = D u + b` with a weak prior D = 1, b = 0.

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes: then every row of D has its own.

    Returns:
        D ``(*B, A, A)``, b ``(*B, A)``, and the covariance of each row of (D, b) in units of the
        noise, ``(*B, A, A + 1, A + 1)``.
    """
    inputs = torch.nn.functional.pad(executed, (0, 1), value=1.0)
    precision = torch.full_like(inputs[..., :1, :], PRIOR)
    left, weights = (effective - executed).mT, weight.expand_as(effective).mT
    change, covariance = regress(inputs, left, weights, precision)
    nominal = torch.eye(executed.shape[-1]).to(executed)
    return nominal + change[..., :-1], change[..., -1], covariance


def invert_affine(matrix: Tensor, bias: Tensor, unit: Tensor) -> Tensor:
    r"""Return the actions ``(*B, A, C)`` whose effects come nearest to what is wanted.

    .. math:: u = (D^\top D + 0.02^2 I)^{-1} D^\top (v - b)

    with D and b of :func:`fit_affine`; the ridge keeps u finite where D is nearly singular.

    Args:
        matrix: D, ``(*B, A, A)``.
        bias: b, ``(*B, A, 1)``.
        unit: what is wanted, ``(*B, A, C)``.
    """
    square = add_diagonal(matrix.mT @ matrix, LEAST_GAIN**2)
    return solve_positive(square, matrix.mT @ (unit - bias))


def not_zero(gain: Tensor, least: Tensor | float = LEAST_GAIN) -> Tensor:
    """Return gains that can be divided by: none smaller than 0.02 in size, or than ``least``."""
    return gain.abs().clamp_min(least).copysign(gain)
