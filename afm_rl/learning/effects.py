"""Transitions taken apart: what an action can explain of an error, and what none can."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics import DynamicsModel

RIDGE = 1e-6  # relative: lets an action axis without any influence stay where it is
ROUNDS = 2  # of Gauss-Newton; one is exact for a model that is affine in its action
LIMIT = 4.0  # half ranges: effective actions beyond carry no more news


class Effect(NamedTuple):
    """Transitions in half ranges of the action and standard deviations of the model."""

    effective: Tensor
    """What the action turned out to be worth, ``(*B, A)``."""
    weight: Tensor
    """One over the variance of each of its components, ``(*B, A)``."""
    rest: Tensor
    """What no action explains of the next state, in standard deviations, ``(*B, D)``."""
    across: Tensor
    """Projection onto what no action reaches, ``(*B, D, D)``."""
    noise: Tensor
    """The model's standard deviation, ``(*B, D)``."""


def take_apart(
    model: DynamicsModel,
    state: Tensor,
    guess: Tensor,
    next_state: Tensor,
    half_range: Tensor,
    offset: Tensor | None = None,
) -> Effect:
    r"""Find the action that explains a transition best, and what it leaves over.

    .. math:: v = \operatorname{argmin}_v \| e(v) \|,\qquad
              e(v) = N^{-1}\,(s_{t+1} \ominus (\mathrm{model}(s, h \odot v) \oplus c))

    by Gauss-Newton steps from a guess; N holds the model's standard deviations.

    Args:
        model: the nominal dynamics.
        state: ``(*B, S)``.
        guess: first v, in half ranges, ``(*B, A)``.
        next_state: the realised one, ``(*B, S)``.
        half_range: h, ``(A,)``.
        offset: c on the tangent space, ``(*B, D)``; None for none.

    >>> from afm_rl.dynamics import Dubins
    >>> s, u = torch.zeros(3), torch.tensor([0.5, 0.2])
    >>> seen = Dubins()(s, -u) + torch.tensor([0.0, 0.01, 0.0])  # reversed, and pushed aside
    >>> effect = take_apart(Dubins(), s, u, seen, torch.ones(2))
    >>> effect.effective, effect.rest.abs().round()
    (tensor([-0.5000, -0.2000]), tensor([ 0., 10.,  0.]))
    """
    unit = guess
    error, noise = _error(model, state, unit * half_range, next_state, offset)
    for _ in range(ROUNDS):
        reach = model.jacobian(state, unit * half_range) * half_range / noise.unsqueeze(-1)
        gram = reach.mT @ reach
        ridge = RIDGE * gram.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(1e-12)
        eye = torch.eye(gram.shape[-1], device=gram.device, dtype=gram.dtype)
        covariance = torch.linalg.inv_ex(gram + ridge[..., None, None] * eye).inverse
        inverse = covariance @ reach.mT
        moved = (unit + (inverse @ error.unsqueeze(-1)).squeeze(-1)).clamp(-LIMIT, LIMIT)
        left, spread = _error(model, state, moved * half_range, next_state, offset)
        # Networks bend beyond their data, where a step can lead away and back again.
        better = (left.norm(dim=-1) < error.norm(dim=-1)).unsqueeze(-1)
        unit = torch.where(better, moved, unit)
        error, noise = torch.where(better, left, error), torch.where(better, spread, noise)
    eye = torch.eye(error.shape[-1], device=error.device, dtype=error.dtype)
    across = eye - reach @ inverse
    rest = (across @ error.unsqueeze(-1)).squeeze(-1)
    weight = 1 / covariance.diagonal(dim1=-2, dim2=-1)
    return Effect(unit, weight, rest, across, noise)


def _error(
    model: DynamicsModel, state: Tensor, action: Tensor, next_state: Tensor, offset: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return the error in standard deviations, and these, ``(*B, D)`` each."""
    expected, noise = model.forecast(state, action)
    if offset is not None:
        expected = model.manifold.add(expected, offset)
    return model.manifold.difference(next_state, expected) / noise, noise
