"""Weighted least squares of effective by executed actions, batched, with a weak nominal prior."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.compiling.tracing import cached
from afm_rl.spaces.small_matrices import add_diagonal, solve_positive

PRIOR = 1e-4  # weight of the nominal map in every fit
LEAST_GAIN = 0.02  # smallest gain that is divided by
OUTLIER = 0.1  # shares of the largest action: such a residual halves a pair's weight


def precision_of(std: Tensor, valid: Tensor) -> Tensor:
    r"""Return weights ``(B, M, A)`` of rows, :math:`1 / (\sigma^2 + 10^{-4})` over the best row's.

    Args:
        std: standard deviation of the effects, ``(B, M, A)``.
        valid: which rows count, ``(B, M, 1)``, 0 or 1.
    """
    weight = valid * (std.square() + PRIOR).reciprocal()
    return weight / weight.amax(-2, keepdim=True).clamp_min(PRIOR)


def fit_gain(executed: Tensor, effective: Tensor, weight: Tensor) -> Tensor:
    r"""Fit :math:`u_\mathrm{eff} = g \odot u`, each axis for itself, with a weak prior g = 1.

    .. math:: g = \frac{\sum_k w_k u_k u_{\mathrm{eff},k} + \rho}{\sum_k w_k u_k^2 + \rho}

    Args:
        executed: u, ``(*B, K, A)``.
        effective: its effective action, ``(*B, K, A)``.
        weight: of pairs, ``(*B, K, 1)``, or of pairs and axes, ``(*B, K, A)``.

    Returns:
        Gains ``(*B, A)``.

    >>> u = torch.tensor([[0.5], [-1.0]])
    >>> fit_gain(u, -2 * u, torch.ones(2, 1)).round(decimals=2)
    tensor([-2.])
    """
    pull = weight * executed
    cross, square = (pull * effective).sum(-2), (pull * executed).sum(-2)
    return (cross + PRIOR) / (square + PRIOR)


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
    u, v = executed.mT, effective.mT
    robust = weight = weight.expand_as(executed).mT
    for turn in range(rounds + 1):
        gain, offset = solve_line(*moments_of(robust.unsqueeze(-2), u, v))  # (*B, A, 1)
        if turn < rounds:
            robust = weight / (1 + ((v - gain * u - offset) / OUTLIER).square())
    return not_zero(gain.squeeze(-1)), offset.squeeze(-1)


@cached(maxsize=16)
def _prior(device: torch.device) -> Tensor:
    """Return the moments of the prior, ``(5,)``."""
    moment = torch.arange(5, device=device)
    slope, mass = (moment == 0) | (moment == 3), moment == 2
    return PRIOR * (slope.double() + 10 * mass.double())  # written so that it can be exported


def moments_of(weights: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, ...]:
    r"""Return what a line needs to know of rows u, v ``(*B, K)``, with a weak prior.

    These are :math:`\sum w u^2`, :math:`\sum w u`, :math:`\sum w`, :math:`\sum w u v` and
    :math:`\sum w v`, ``(*B, W)`` each, for W weights of the rows ``(*B, W, K)``.
    """
    terms = torch.stack([u * u, u, torch.ones_like(u), u * v, v], -1)
    return (weights @ terms + _prior(u.device).to(u)).unbind(-1)


def solve_line(
    square: Tensor, mean: Tensor, mass: Tensor, cross: Tensor, shift: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return slope and offset ``(*B)`` of weighted least squares, given its moments ``(*B)``.

    See :func:`moments_of`.
    """
    determinant = (square * mass - mean * mean).clamp_min(PRIOR**2)
    slope = (mass * cross - mean * shift) / determinant
    return slope, (square * shift - mean * cross) / determinant


def variance_of_line(square: Tensor, mean: Tensor, mass: Tensor) -> Tensor:
    r"""Return the variance of a line's prediction, in units of the noise, by its moments ``(*B)``.

    Bayesian linear regression: :math:`x^T (X^T W X + \rho)^{-1} x` with x = (u, 1), as
    :math:`c_0 + c_1 u + c_2 u^2`, ``(*B, 3)``.

    >>> u = torch.tensor([1.0, -1.0])
    >>> square, mean, mass, _, _ = moments_of(torch.ones(1, 2), u, u)
    >>> variance_of_line(square, mean, mass).abs().round(decimals=2)
    tensor([[0.5000, 0.0000, 0.5000]])
    """
    determinant = (square * mass - mean * mean).clamp_min(PRIOR**2)
    return torch.stack([square, -2 * mean, mass], -1) / determinant.unsqueeze(-1)


def quadratic(coefficient: Tensor, power: int) -> Tensor:
    """Return the coefficients ``(*B, 3)`` of a polynomial with one term, of ``(*B)``."""
    return torch.nn.functional.pad(coefficient.unsqueeze(-1), (power, 2 - power))


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
