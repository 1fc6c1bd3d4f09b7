"""Least-squares fits of simple maps to pairs (executed, effective action), axis by axis."""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.spaces.small_matrices import add_diagonal, solve_positive

STUCK = 5e-3  # half ranges: an action with less effect is held by friction
PRIOR = 1e-4  # weight of the nominal map in every fit
LEAST_GAIN = 0.02  # smallest gain that is divided by
NOISE = 0.1  # half ranges: a pair with this standard deviation counts half
OUTLIER = 0.1  # half ranges: a residual of this size halves a pair's weight in the robust fit


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
    return not_zero(cross / ((pull * executed).sum(-2) + PRIOR))


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
    terms = torch.stack([executed * executed, executed, ones, executed * effective, effective], -3)
    robust = weight
    for turn in range(rounds + 1):
        square, mean, mass, cross, shift = (terms * robust.unsqueeze(-3)).sum(-2).unbind(-2)
        gain, offset = solve_line(square + PRIOR, mean, mass + 10 * PRIOR, cross + PRIOR, shift)
        if turn < rounds:
            miss = effective - (gain.unsqueeze(-2) * executed + offset.unsqueeze(-2))
            robust = weight / (1 + (miss / OUTLIER).square())
    return not_zero(gain), offset


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


def fit_affine(executed: Tensor, effective: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fit :math:`u_\mathrm{eff} = D u + b` with a weak prior D = 1, b = 0.

    Args as for :func:`fit_gain`; with weights per axis every row of D has its own.

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
