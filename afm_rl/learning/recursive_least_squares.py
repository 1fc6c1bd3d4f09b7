"""Recursive least squares with exponential forgetting, in information form."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

FADE, LEAST = 0.5, 1e-4  # of the prior per transition, and what stays of it


class Information(NamedTuple):
    r"""What G regressions :math:`y = \theta^\top \phi` were told: a Gaussian, information form."""

    gram: Tensor
    r""":math:`\Lambda = \sum w\,\phi\phi^\top`, ``(*L, G, R, R)``."""
    moment: Tensor
    r""":math:`\eta = \sum w\,\phi\,y`, ``(*L, G, R)``."""


def absorb(
    known: Information, features: Tensor, target: Tensor, weight: Tensor, forgetting: float = 1.0
) -> Information:
    r"""Add a transition: :math:`\Lambda \leftarrow \lambda\Lambda + w\phi\phi^\top`, eta likewise.

    Args:
        known: information so far, ``(*L, G, R, R)`` and ``(*L, G, R)``.
        features: phi, ``(*L, R)``.
        target: y, one per regression, ``(*L, G)``.
        weight: w, one over the variance of the noise, ``(*L, G)``.
        forgetting: lambda.

    >>> known = Information(torch.zeros(1, 2, 2), torch.zeros(1, 2))
    >>> for u in (-1.0, 0.5, 2.0):
    ...     known = absorb(known, torch.tensor([u, 1]), torch.tensor([3 * u + 1]), torch.ones(1))
    >>> solve(known, torch.full((1, 2), 1e-6), torch.zeros(1, 2))[0].round(decimals=3)
    tensor([[3., 1.]])
    """
    outer = features.unsqueeze(-1) * features.unsqueeze(-2)
    gram = forgetting * known.gram + weight[..., None, None] * outer.unsqueeze(-3)
    moment = forgetting * known.moment + (weight * target).unsqueeze(-1) * features.unsqueeze(-2)
    return Information(gram, moment)


def solve(known: Information, prior: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the posterior's mean and covariance.

    .. math:: \Sigma = (\Lambda + P)^{-1},\qquad \theta = \mu + \Sigma\,(\eta - \Lambda\mu)

    Args:
        known: the information of the data.
        prior: diagonal of P, the prior's information, > 0, ``(*L, G, R)``.
        mean: mu, where the prior pulls, ``(*L, G, R)``.

    Returns:
        theta ``(*L, G, R)`` and Sigma ``(*L, G, R, R)``.
    """
    covariance = torch.linalg.inv_ex(known.gram + torch.diag_embed(prior)).inverse
    news = known.moment - (known.gram @ mean.unsqueeze(-1)).squeeze(-1)
    return mean + (covariance @ news.unsqueeze(-1)).squeeze(-1), covariance


def fading(prior: Tensor, age: Tensor) -> Tensor:
    """Return the prior's information at an age ``(*L)``: it leads first and hardly pulls later.

    >>> fading(torch.ones(1, 1), torch.tensor([0.0, 2.0])).flatten()
    tensor([1.0000, 0.2500])
    """
    return prior * (FADE**age).clamp_min(LEAST)[..., None, None]
