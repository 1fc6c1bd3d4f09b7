"""Recursive least squares with outliers, changes and competing hypotheses."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

PRIOR_DECAY, LEAST_PRIOR = 0.5, 1e-4  # of the prior per transition, and what stays of it
NOISE_RATE = 0.2  # growth or decay of the noise level per transition
SCORE_MEMORY = 0.8  # weight of the past in the comparison of hypotheses
MARGIN = 0.7  # by how much the mean log squared error must be lower than the nominal model's
SIMPLER = 1.0  # and lower than the first hypothesis's, for one of the others to be used
CREDIBLE = 1.0  # above the lowest mean log squared error: hypotheses beyond explain nothing


class Information(NamedTuple):
    r"""What regressions :math:`y = \theta^\top \phi` know: a Gaussian in information form."""

    gram: Tensor
    r""":math:`\Lambda = \sum w\,\phi\phi^\top`, ``(*L, R, R)``."""
    moment: Tensor
    r""":math:`\eta = \sum w\,\phi\,y`, ``(*L, R)``."""


def absorb(known: Information, features: Tensor, target: Tensor, weight: Tensor) -> Information:
    r"""Add transitions: :math:`\Lambda \leftarrow \Lambda + w\phi\phi^\top`, eta likewise.

    Args:
        known: information so far, ``(*L, R, R)`` and ``(*L, R)``.
        features: phi, ``(*L, R)``.
        target: y, ``(*L)``.
        weight: w, one over the variance of the noise, ``(*L)``.

    >>> known = Information(torch.zeros(2, 2), torch.zeros(2))
    >>> for u in (-1.0, 0.5, 2.0):
    ...     y = torch.tensor(3 * u + 1)
    ...     known = absorb(known, torch.tensor([u, 1]), y, torch.tensor(1.0))
    >>> solve(known, torch.full((2,), 1e-6), torch.zeros(2))[0].round(decimals=3)
    tensor([3., 1.])
    """
    weighted = weight.unsqueeze(-1) * features
    gram = known.gram + weighted.unsqueeze(-1) * features.unsqueeze(-2)
    return Information(gram, known.moment + weighted * target.unsqueeze(-1))


def solve(known: Information, prior: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the posterior's mean and covariance.

    .. math:: \Sigma = (\Lambda + P)^{-1},\qquad \theta = \mu + \Sigma\,(\eta - \Lambda\mu)

    Args:
        known: the information of the data.
        prior: diagonal of P, the prior's information, > 0, ``(*L, R)``.
        mean: mu, where the prior pulls, ``(*L, R)``.

    Returns:
        theta ``(*L, R)`` and Sigma ``(*L, R, R)``.
    """
    covariance = torch.linalg.inv_ex(known.gram + torch.diag_embed(prior)).inverse
    news = known.moment - (known.gram @ mean.unsqueeze(-1)).squeeze(-1)
    return mean + (covariance @ news.unsqueeze(-1)).squeeze(-1), covariance


class Filter(NamedTuple):
    """What is known of l missions, under H hypotheses with G regressions each."""

    gram: Tensor
    """``(l, H, G, R, R)``, see :class:`Information`; the prior is no part of it."""
    moment: Tensor
    """``(l, H, G, R)``."""
    held_gram: Tensor
    """Of an innovation that the next transition has to confirm, likewise."""
    held_moment: Tensor
    """``(l, H, G, R)``."""
    held: Tensor
    """Was the last transition such an innovation? ``(l)``."""
    age: Tensor
    """Transitions since learning began or began anew, ``(l)``."""
    noise: Tensor
    """Typical normalised innovation, at least 1, ``(l)``."""
    score: Tensor
    """Mean of log(1 + squared error) of the nominal model and each hypothesis, ``(l, 1 + H)``."""

    @property
    def known(self) -> Information:
        """The information of the transitions that count."""
        return Information(self.gram, self.moment)

    @property
    def best(self) -> Tensor:
        """The hypothesis to use ``(l)``; -1: the nominal model, which none clearly beats."""
        score = self.score[:, 1:].clone()
        score[:, 1:] += SIMPLER
        score, index = score.min(1)
        return torch.where(score < self.score[:, 0] - MARGIN, index, -1)


class News(NamedTuple):
    """The latest transition of each mission."""

    known: Information
    """Its information under each hypothesis, ``(l, H, G, R, R)``."""
    error: Tensor
    """Error of the nominal model and each hypothesis, normalised by noise, ``(l, 1 + H)``."""
    innovation: Tensor
    """The same, normalised by noise and uncertainty of the fit, ``(l, 1 + H)``."""
    exciting: Tensor
    """Does it tell anything about slopes? ``(l)``."""
    valid: Tensor
    """Does it count at all? ``(l)``."""


def empty_filter(missions: int, hypotheses: int, regressions: int, size: int) -> Filter:
    """Return the filter of missions that have seen nothing, in double precision."""
    gram = torch.zeros(missions, hypotheses, regressions, size, size, dtype=torch.float64)
    count = torch.zeros(missions, dtype=torch.float64)
    known = (gram, gram[..., 0], gram, gram[..., 0])
    score = torch.zeros(missions, 1 + hypotheses, dtype=torch.float64)
    return Filter(*known, held=count.bool(), age=count, noise=count + 1, score=score)


def fading_prior(prior: Tensor, age: Tensor) -> Tensor:
    """Return the prior's information at an age ``(l)``: it leads first and hardly pulls later."""
    return prior * (PRIOR_DECAY**age).clamp_min(LEAST_PRIOR)[:, None, None, None]


def update(now: Filter, news: News, forgetting: float, gate: float) -> Filter:
    """Take in one transition per mission.

    * An innovation beyond the gate under every *credible* hypothesis is held back, once there are
      enough transitions to know. If the next transition is none, it was an outlier and is
      dropped. If it is one too, the regime has changed: both are kept and everything before them
      is forgotten.
    * The gate is in units of the typical innovation, if that exceeds the model's own noise: under
      a flickering gain every transition is a surprise, but nothing changes.
    * The hypothesis with the lowest mean log squared error of late is used, if it clearly beats
      the nominal model: otherwise predictions are those of the nominal model, to the bit.

    Missions whose transition is not valid stay as they are. Transitions that tell nothing
    about slopes are learnt from, but let nothing be forgotten.
    """
    credible = now.score <= now.score.amin(1, keepdim=True) + CREDIBLE
    innovation = torch.where(credible, news.innovation, torch.inf).amin(1)
    ready = now.age > now.moment.shape[-1] + 1  # else a change looks like a poor fit
    suspect = ready & (innovation > gate * now.noise)
    held, changed = suspect & ~now.held, suspect & now.held
    keep = torch.where(news.exciting, forgetting, 1.0).to(now.noise)
    keep = torch.where(changed, 0.0, keep)

    def grown(old: Tensor, waiting: Tensor, new: Tensor) -> Tensor:
        shape = (-1, *(1,) * (old.dim() - 1))
        confirmed = torch.where(changed.reshape(shape), waiting, 0.0)
        return torch.where(held.reshape(shape), old, keep.reshape(shape) * old + confirmed + new)

    level = now.noise * torch.where(innovation > now.noise, NOISE_RATE, -NOISE_RATE).exp()
    level = torch.where(ready & ~held, level, now.noise)
    latest = news.error.square().log1p()
    # After a change fits are taken to be no better than the gate, the nominal model as it just was.
    score = torch.lerp(latest, now.score, SCORE_MEMORY)
    fresh = (gate * now.noise).square().log1p()[:, None].expand_as(latest[:, 1:])
    begun = torch.cat([latest[:, :1], fresh], 1)
    score = torch.where(changed[:, None], begun, score)
    frozen = (held | ~news.exciting)[:, None]
    after = Filter(
        gram=grown(now.gram, now.held_gram, news.known.gram),
        moment=grown(now.moment, now.held_moment, news.known.moment),
        held_gram=_where(held, news.known.gram, torch.zeros_like(now.gram)),
        held_moment=_where(held, news.known.moment, torch.zeros_like(now.moment)),
        held=held,
        age=torch.where(changed, 2.0, now.age + ~held),
        noise=level.clamp(1.0, 1e6),
        score=torch.where(frozen & ~changed[:, None], now.score, score),
    )
    return Filter(*(_where(news.valid, *pair) for pair in zip(after, now, strict=True)))


def _where(missions: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Return ``new`` for some ``missions`` ``(l)`` and ``old`` for the others, ``(l, ...)``."""
    return torch.where(missions.reshape(-1, *(1,) * (old.dim() - 1)), new, old)
