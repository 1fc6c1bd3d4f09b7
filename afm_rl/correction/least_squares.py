"""Weighted least squares with a weak prior, batched: the fits of the textbook correctors."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.spaces.small_matrices import add_diagonal, invert_positive, solve_positive

PRIOR = 1e-4  # weight of the nominal map in every fit
OF_OFFSET = 1e-3  # weight of an offset of zero in a line
LEAST_GAIN = 0.02  # smallest gain that is divided by
OUTLIER = 0.1  # shares of the largest action: such a residual halves a pair's weight


def fit_gain(executed: Tensor, effective: Tensor, weight: Tensor) -> Tensor:
    r"""Return g of :math:`u_\mathrm{eff} = g \odot u`, ``(*B, A)``, with a weak prior g = 1.

    .. math:: g = \frac{\sum_k w_k u_k u_{\mathrm{eff},k} + \rho}{\sum_k w_k u_k^2 + \rho}

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes, ``(*B, K, A)``.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> fit_gain(u, -2 * u, torch.ones(2, 1)).round(decimals=2)
    tensor([-2.])
    """
    pull = weight * executed
    return ((pull * effective).sum(-2) + PRIOR) / ((pull * executed).sum(-2) + PRIOR)


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
    inputs = torch.stack([torch.ones_like(executed), executed], -1).transpose(-3, -2)
    left, weight = (effective - executed).mT, weight.expand_as(executed).mT  # (*B, A, K)
    # No constant tensor: an exported branch must not hold one.
    robust, precision = weight, OF_OFFSET + (PRIOR - OF_OFFSET) * torch.arange(2).to(executed)
    for _ in range(rounds):
        residuals = left - (inputs @ regress(inputs, left, robust, precision)[..., None])[..., 0]
        robust = weight / (1 + (residuals / OUTLIER).square())
    offset, gain = regress(inputs, left, robust, precision).unbind(-1)
    return not_zero(1 + gain), offset


def fit_affine(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = D u + b` with a weak prior D = 1, b = 0.

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes: then every row of D has its own.

    Returns:
        D ``(*B, A, A)``, and b ``(*B, A)``.
    """
    inputs = torch.nn.functional.pad(executed, (0, 1), value=1.0).unsqueeze(-3)
    left, weights = (effective - executed).mT, weight.expand_as(effective).mT
    change = regress(inputs, left, weights, torch.full_like(inputs[..., 0, :], PRIOR))
    nominal = torch.eye(executed.shape[-1]).to(executed)
    return nominal + change[..., :-1], change[..., -1]


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


def not_zero(gain: Tensor) -> Tensor:
    """Return gains that can be divided by: none smaller than 0.02 in size."""
    return gain.abs().clamp_min(LEAST_GAIN).copysign(gain)


def regress(inputs: Tensor, outputs: Tensor, weights: Tensor, precision: Tensor) -> Tensor:
    r"""Return the coefficients ``(*B, N)`` of a Bayesian linear regression, a priori 0.

    .. math:: \theta = (X^\top W X + \Lambda)^{-1} X^\top W y

    Args:
        inputs: X, ``(*B, K, N)``.
        outputs: y, ``(*B, K)``.
        weights: W, ``(*B, K)``.
        precision: diagonal of :math:`\Lambda`, ``(*B, N)``.
    """
    weighted = inputs.mT * weights.unsqueeze(-2)
    covariance = invert_positive(weighted @ inputs + torch.diag_embed(precision))
    return (covariance @ (weighted @ outputs.unsqueeze(-1))).squeeze(-1)
