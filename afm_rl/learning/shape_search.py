"""Which static shape of the actuators explains a window of transitions best."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.dynamics.hammerstein import PLAIN, shaped
from afm_rl.learning.least_squares import least_squares

FIRST, NEXT, ROUNDS = 24, 9, 5  # points of the first grid, of each finer one, number of these
FAMILIES = {"dead_zone": (0, 0.02, 0.8), "limit": (1, 0.05, 0.97), "slip": (2, 0.3, 8.0)}
"""Column of the shape that a family is about, its lowest and its highest value."""


class Rows(NamedTuple):
    """Transitions in half ranges."""

    action: Tensor
    """u, ``(*L, K, A)``."""
    effective: Tensor
    """v, the effective action, ``(*L, K, A)``."""
    weight: Tensor
    """One over the variance of v; 0 for rows that do not count, ``(*L, K, A)``."""


class Found(NamedTuple):
    """The best shape, and how much it leaves unexplained."""

    shape: Tensor
    """``(l, 3)``."""
    cost: Tensor
    """Sum over transitions of the squared error, each at most ``cap`` squared, ``(l)``."""
    plain: Tensor
    """The same without any shape, ``(l)``."""


def features_of(action: Tensor, shape: Tensor) -> Tensor:
    """Return what the effective action is linear in, ``(*B, A + 1)``: the shaped command and 1.

    >>> features_of(torch.tensor([0.5]), torch.tensor([0.25, 1.0, 0.0]))
    tensor([0.2500, 1.0000])
    """
    command = shaped(action, shape)
    return torch.cat([command, torch.ones_like(command[..., :1])], -1)


def fit(rows: Rows, shape: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean ``(*L, A, A + 1)`` and covariance of D and b side by side, for a given shape.

    Args:
        rows: ``(*L, K, A)``.
        shape: ``(*L, 3)``.
        prior: information of the prior, around the identity, ``(*L, A, A + 1)``.
    """
    mean = torch.eye(*prior.shape[-2:], dtype=prior.dtype, device=prior.device).expand_as(prior)
    features = features_of(rows.action, shape.unsqueeze(-2))
    return least_squares(features, rows.effective, rows.weight, prior, mean)


def cost_of(rows: Rows, shape: Tensor, theta: Tensor, cap: float) -> Tensor:
    """Return the sum ``(*L)`` of squared normalised errors, each at most ``cap`` squared."""
    fitted = features_of(rows.action, shape.unsqueeze(-2)) @ theta.mT
    errors = ((rows.effective - fitted).square() * rows.weight).amax(-1)
    return errors.clamp_max(cap**2).sum(-1)


def search(rows: Rows, prior: Tensor, cap: float) -> Found:
    """Search each family of shapes by ever finer grids, the linear part solved for each point.

    Variable projection (Golub & Pereyra 1973), the one nonlinear number found by search: dead
    zones and limits have kinks.

    Args:
        rows: transitions, ``(l, K, A)``.
        prior: information of the linear part's prior, ``(A, A + 1)``.
        cap: normalised error beyond which a transition costs no more.

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
        lead = shape.shape[1:-1]
        wide = Rows(*(part.reshape(len(part), *(1,) * len(lead), *part.shape[1:]) for part in rows))
        theta, _ = fit(wide, shape, prior.expand(len(like), *lead, *prior.shape))
        return cost_of(wide, shape, theta, cap)

    for points in (FIRST, *[NEXT] * ROUNDS):
        share = torch.linspace(0, 1, points, dtype=like.dtype, device=like.device)
        value = torch.lerp(low.unsqueeze(-1), high.unsqueeze(-1), share)  # (l, F, points), logs
        cost, best = costs(torch.where(chosen[:, None], value.exp().unsqueeze(-1), plain)).min(-1)
        middle = value.gather(-1, best.unsqueeze(-1)).squeeze(-1)
        reach = (high - low) / (points - 1)
        low, high = middle - reach, middle + reach
    cost, family = cost.min(-1)
    number = middle.exp().gather(-1, family.unsqueeze(-1))
    shape = torch.where(chosen[family], number, plain)
    return Found(shape, cost, costs(plain.expand(len(like), 3)))
