"""Weighted least squares with a prior, in information form."""

from __future__ import annotations

import torch
from torch import Tensor

FADE, LEAST = 0.5, 1e-4  # of the prior per transition, and what stays of it


def least_squares(
    features: Tensor, target: Tensor, weight: Tensor, prior: Tensor, mean: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return mean and covariance of G regressions :math:`y_g = \theta_g^\top \phi`.

    .. math:: \Sigma_g = (\Phi^\top W_g \Phi + P_g)^{-1},\qquad
              \theta_g = \mu_g + \Sigma_g \Phi^\top W_g (y_g - \Phi \mu_g)

    Args:
        features: phi of K rows, ``(*L, K, R)``.
        target: y, ``(*L, K, G)``.
        weight: one over the variance of the noise, 0 for rows that do not count, ``(*L, K, G)``.
        prior: diagonal of P, the prior's information, > 0, ``(*L, G, R)``.
        mean: mu, where the prior pulls, ``(*L, G, R)``.

    Returns:
        theta ``(*L, G, R)`` and Sigma ``(*L, G, R, R)``.

    >>> u = torch.tensor([-1.0, 0.5, 2.0])
    >>> rows = torch.stack([u, torch.ones(3)], -1), (3 * u + 1).unsqueeze(-1), torch.ones(3, 1)
    >>> least_squares(*rows, torch.full((1, 2), 1e-6), torch.zeros(1, 2))[0].round(decimals=3)
    tensor([[3., 1.]])
    """
    weighted = weight.mT.unsqueeze(-1) * features.unsqueeze(-3)  # (*L, G, K, R)
    gram = weighted.mT @ features.unsqueeze(-3)
    left = target - features @ mean.mT
    moment = weighted.mT @ left.mT.unsqueeze(-1)
    covariance = torch.linalg.inv_ex(gram + torch.diag_embed(prior)).inverse
    return mean + (covariance @ moment).squeeze(-1), covariance


def fading(prior: Tensor, age: Tensor) -> Tensor:
    """Return the prior's information at an age ``(*L)``: it leads first and hardly pulls later.

    >>> fading(torch.ones(1, 1), torch.tensor([0.0, 2.0])).flatten()
    tensor([1.0000, 0.2500])
    """
    return prior * (FADE**age).clamp_min(LEAST)[..., None, None]
