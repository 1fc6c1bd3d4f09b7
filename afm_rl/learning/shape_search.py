"""Which static shape of the actuators explains a window of transitions best."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics.hammerstein import PLAIN, shaped
from afm_rl.learning.recursive_least_squares import Information, solve

FIRST, NEXT, ROUNDS = 24, 9, 5  # points of the first grid, of each finer one, number of these
FAMILIES = {"dead_zone": (0, 0.02, 0.8), "limit": (1, 0.05, 0.97), "slip": (2, 0.3, 8.0)}
"""Column of the shape that a family is about, its lowest and its highest value."""


class Rows(NamedTuple):
    """Transitions in half ranges, oldest first."""

    action: Tensor
    """u, ``(l, K, A)``."""
    effective: Tensor
    """v, what it was worth, ``(l, K, A)``."""
    weight: Tensor
    """One over the variance of v; 0 where there is no transition, ``(l, K, A)``."""


class Found(NamedTuple):
    """The best shape, and what it leaves."""

    shape: Tensor
    """``(l, 3)``."""
    cost: Tensor
    """Sum over transitions of the squared surprise, each at most ``cap`` squared, ``(l)``."""
    plain: Tensor
    """The same without any shape, ``(l)``."""


def features_of(action: Tensor, shape: Tensor) -> Tensor:
    """Return what the effective action is linear in, ``(*B, A + 1)``: the shaped command and 1.

    >>> features_of(torch.tensor([0.5]), torch.tensor([0.25, 1.0, 0.0]))
    tensor([0.2500, 1.0000])
    """
    command = shaped(action, shape)
    return torch.cat([command, torch.ones_like(command[..., :1])], -1)


def latest(rows: Rows, count: Tensor, forgetting: float = 1.0) -> Rows:
    """Blank all but the latest ``count`` ``(l)`` rows, and forget the older of these."""
    size = rows.weight.shape[1]
    age = torch.arange(size - 1, -1, -1, device=count.device)
    share = (age < count.unsqueeze(-1)) * forgetting**age
    return rows._replace(weight=rows.weight * share.unsqueeze(-1))


def told_by(rows: Rows, shape: Tensor) -> tuple[Information, Tensor]:
    """Return the information of rows under shapes ``(l, *G, 3)``, and the features.

    Their sizes are ``(l, *G, A, R, R)``, ``(l, *G, A, R)`` and ``(l, *G, K, R)``, R = A + 1.
    """
    action, effective, weight = _wide(rows, shape)
    features = features_of(action, shape.unsqueeze(-2))
    weighted = weight.mT.unsqueeze(-1) * features.unsqueeze(-3)  # (l, *G, A, K, R)
    gram = weighted.mT @ features.unsqueeze(-3)
    moment = (weighted * effective.mT.unsqueeze(-1)).sum(-2)
    return Information(gram, moment), features


def surprises(rows: Rows, features: Tensor, theta: Tensor) -> Tensor:
    """Return the squared surprise ``(l, *G, K)`` of rows under fits ``(l, *G, A, R)``."""
    _, effective, weight = _wide(rows, theta[..., 0])
    return ((effective - features @ theta.mT).square() * weight).amax(-1)


def search(rows: Rows, prior: Tensor, cap: float) -> Found:
    """Search each family of shapes by ever finer grids, the linear part solved for each point.

    Variable projection (Golub & Pereyra 1973), the one nonlinear number found by search: dead
    zones and limits have kinks.

    Args:
        rows: transitions.
        prior: information of the linear part's prior, ``(A, A + 1)``.
        cap: surprise beyond which a transition costs no more.

    >>> u = torch.linspace(-1, 1, 16, dtype=torch.float64).reshape(1, 16, 1)
    >>> v = -2 * u.sign() * (u.abs() - 0.3).clamp_min(0)
    >>> search(Rows(u, v, torch.full_like(u, 1e4)), torch.full((1, 2), 1e-4), 5.0).shape
    tensor([[0.3000,    inf, 0.0000]], dtype=torch.float64)
    """
    like = rows.action
    prior, plain = prior.to(like), like.new_tensor(PLAIN)
    columns, *bounds = zip(*FAMILIES.values(), strict=True)
    chosen = torch.nn.functional.one_hot(torch.tensor(columns, device=like.device), 3).bool()
    low, high = (like.new_tensor(bound).log().expand(len(like), -1) for bound in bounds)

    def costs(shape: Tensor) -> Tensor:
        known, features = told_by(rows, shape)
        mean = torch.eye(*prior.shape, dtype=like.dtype, device=like.device)
        theta, _ = solve(known, prior, mean.expand_as(known.moment))
        return surprises(rows, features, theta).clamp_max(cap**2).sum(-1)

    for points in (FIRST, *[NEXT] * ROUNDS):
        share = torch.linspace(0, 1, points, dtype=like.dtype, device=like.device)
        value = torch.lerp(low.unsqueeze(-1), high.unsqueeze(-1), share)  # (l, F, points), logs
        cost, best = costs(torch.where(chosen[:, None], value.exp().unsqueeze(-1), plain)).min(-1)
        middle, reach = (
            value.gather(-1, best.unsqueeze(-1)).squeeze(-1),
            (high - low) / (points - 1),
        )
        low, high = middle - reach, middle + reach
    cost, family = cost.min(-1)
    number = middle.exp().gather(-1, family.unsqueeze(-1))
    shape = torch.where(chosen[family], number, plain)
    return Found(shape, cost, costs(plain.expand(len(like), 3)))


def _wide(rows: Rows, like: Tensor) -> Rows:
    """Insert dimensions into rows ``(l, K, A)`` so that they go with ``(l, *G, 3)``."""
    extra = like.dim() - 2
    return Rows(*(part.reshape(len(part), *(1,) * extra, *part.shape[1:]) for part in rows))
