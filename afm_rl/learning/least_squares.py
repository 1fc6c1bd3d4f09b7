"""Recursive least squares with forgetting, which starts anew where the regime has changed."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Rows(NamedTuple):
    """The latest transitions of l missions, n simultaneous ones, of K rows each."""

    features: Tensor
    """What the deviation is linear in, phi ``(l, n K, R)``."""
    deviation: Tensor
    """How far the robot was from what the nominal model says, y ``(l, n K, G)``."""
    weight: Tensor
    """One over the variance of the noise of y, w ``(l, n K, G)``."""
    valid: Tensor
    """Which transitions count, ``(l, n)``."""
    exciting: Tensor
    """Which of them say anything about slopes, ``(l, n)``: nothing is forgotten for the others."""
    prior: Tensor
    """Information of the prior of a fit that begins here, ``(l, G, R)``."""


class Fit(NamedTuple):
    r"""G regressions :math:`y_g = \theta_g^\top \phi` for each of l missions.

    >>> u, zero = torch.tensor([[[-1.0], [0.5], [2.0]]]).double(), torch.zeros(1, 3).bool()
    >>> rows = Rows(u, 3 * u, torch.ones_like(u), ~zero, ~zero, torch.full((1, 1, 1), 1e-6))
    >>> advance(nothing(1, 1, 1), rows, gate=1.0).solution()[0].round(decimals=3)
    tensor([[[3.]]], dtype=torch.float64)
    """

    information: Tensor
    """Sum of w phi phi' over the transitions that count, ``(l, G, R, R)``."""
    moment: Tensor
    """Sum of w phi y over them, ``(l, G, R)``."""
    prior: Tensor
    """Information of the prior, around zero, ``(l, G, R)``."""
    age: Tensor
    """Number of transitions since the fit began, ``(l)``."""
    level: Tensor
    """Median innovation so far, at least 1: the level of the noise, ``(l)``."""
    quiet: Tensor
    """For how many transitions the nominal model has been as good as the fit, ``(l)``."""
    active: Tensor
    """Is there a fit? Otherwise the nominal model holds, ``(l)``."""

    def solution(self) -> tuple[Tensor, Tensor]:
        r"""Return mean ``(l, G, R)`` and covariance ``(l, G, R, R)`` of theta.

        .. math:: \Sigma_g = (\textstyle\sum w \phi \phi^\top + P_g)^{-1},\qquad
                  \theta_g = \Sigma_g \textstyle\sum w \phi y_g

        The prior P halves with each transition: it leads first and hardly pulls later.
        """
        fading = (0.5**self.age).clamp_min(1e-4)[:, None, None]
        precision = self.information + torch.diag_embed(self.prior * fading)
        covariance = torch.linalg.inv_ex(precision).inverse
        return (covariance @ self.moment.unsqueeze(-1)).squeeze(-1), covariance


def nothing(
    missions: int, regressions: int, features: int, device: torch.device | None = None
) -> Fit:
    """Return what is known at first, in double precision: the nominal model holds."""
    shape = missions, regressions, features, features
    matrix = torch.zeros(shape, device=device, dtype=torch.float64)
    vector, count = matrix[..., 0], matrix.new_zeros(missions)
    return Fit(matrix, vector, vector + 1, count, count + 1, count, count.bool())


def advance(
    fit: Fit, rows: Rows, forgetting: float = 0.97, gate: float = 5.0, patience: int = 10
) -> Fit:
    """Take in the latest transitions; nothing happens to missions without a valid one.

    * An innovation beyond the gate is a change: what was known is dropped, and a fit begins with
      this transition, or none if the nominal model explains it. A fit of few transitions is not
      judged yet.
    * Innovations are measured by the noise that the fit has had so far, if that is more than the
      model's: a robot of which no transition is as predicted is noisy, it does not change.
    * A fit is also dropped once the nominal model has been as good for long.

    Args:
        fit: what is known.
        rows: the transitions.
        forgetting: weight of a transition relative to the next one, in (0, 1].
        gate: standard deviations of the prediction beyond which an innovation is a change.
        patience: transitions for which the nominal model is as good before a fit is dropped.
    """
    theta, covariance = fit.solution()
    features, y, weight, valid, exciting, prior = rows
    variance = torch.einsum("lnr,lgrk,lnk->lng", features, covariance, features)
    error = (y - features @ theta.mT).square() * weight / (1 + weight * variance)
    innovation, nominal = _size(error, valid), _size(y.square() * weight, valid)
    innovation = torch.where(fit.active, innovation, nominal)
    shown, telling = valid.any(-1), (exciting & valid).any(-1)
    explained = nominal <= gate
    settled = fit.active & (fit.age > features.shape[-1] + 1)
    changed = (innovation > gate * fit.level) & (settled | ~fit.active)
    as_good = explained & (nominal <= 1.5 * innovation.clamp_min(1.0))
    quiet = torch.where(fit.active & as_good, fit.quiet + telling, 0.0)
    ended = fit.active & ((changed & explained) | (quiet >= patience))
    active, fresh = (fit.active | changed) & ~ended, changed | ended
    # A median that is followed: up by a fifth where it is exceeded, else down.
    rise = torch.where(innovation > fit.level, 0.2, -0.2).exp()
    level = torch.where(settled, (fit.level * rise).clamp_min(1.0), fit.level)
    keep = torch.where(fresh, 0.0, torch.where(telling, forgetting, 1.0).to(y))
    rows_of = y.shape[1] // valid.shape[1]
    counts = (valid & active.unsqueeze(-1)).repeat_interleave(rows_of, 1).unsqueeze(-1)
    weighted = (weight * counts).mT.unsqueeze(-1) * features.unsqueeze(1)
    after = Fit(
        information=_like(keep, fit.information) * fit.information
        + weighted.mT @ features.unsqueeze(1),
        moment=_like(keep, fit.moment) * fit.moment + (weighted * y.mT.unsqueeze(-1)).sum(-2),
        prior=torch.where(_like(fresh, prior), prior, fit.prior),
        age=torch.where(fresh, 0.0, fit.age) + active,
        level=torch.where(ended, 1.0, level),
        quiet=torch.where(fresh, 0.0, quiet),
        active=active,
    )
    return Fit(
        *(torch.where(_like(shown, new), new, old) for new, old in zip(after, fit, strict=True))
    )


def _like(missions: Tensor, part: Tensor) -> Tensor:
    """Return one number per mission, ``(l)``, as it broadcasts with ``(l, ...)``."""
    return missions.reshape(-1, *(1,) * (part.dim() - 1))


def _size(squares: Tensor, valid: Tensor) -> Tensor:
    """Return the largest error of each transition, of these the median ``(l)``; 0 for none."""
    largest = squares.flatten(1).unflatten(1, (valid.shape[1], -1)).amax(-1).sqrt()
    return torch.where(valid, largest, torch.nan).nanmedian(-1).values.nan_to_num(0.0)
