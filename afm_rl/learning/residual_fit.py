"""What a model misses of a healthy robot, by ridge regression on some of its steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from afm_rl.dynamics.base import DynamicsModel
from afm_rl.dynamics.linear_residual import FAR
from afm_rl.spaces.manifold import Manifold

PENALTIES = (1.0, 10.0, 100.0, 1000.0)
FREE = 1e-6  # penalty of the intercept, which is not shrunk
FOLDS = 4


@torch.no_grad()
def residual_parts(
    manifold: Manifold, state: Tensor, predicted: Tensor, after: Tensor, relevant: Tensor
) -> dict[str, Tensor]:
    r"""Return the parts of a :class:`~afm_rl.dynamics.LinearResidual` that fit healthy steps.

    .. math:: w_d = \operatorname{argmin}_w \sum_t (e_{td} - w^\top [1, z_t])^2
              + \lambda_d \sum_{k > 0} w_k^2

    for each coordinate d of the misses e. Each quarter of the time is predicted from the other
    three, because neighbouring steps would tell each other's misses; :math:`\lambda_d` is the
    penalty with the least error. A coordinate is adjusted only if that is less than without a
    residual in *every* quarter. The measured noise is the root mean square of these errors.

    Args:
        manifold: of the states.
        state, after: N steps of each robot in the order of time, ``(*L, N, S)``.
        predicted: next states by the nominal model, ``(*L, N, S)``.
        relevant: on which coordinates of the state the motion depends, ``(*L, S)``.
    """
    state, predicted, after = state.double(), predicted.double(), after.double()
    motion = manifold.difference(predicted, state)
    missed = manifold.difference(after, predicted)
    x = torch.cat([state, motion], -1)
    mean, std = x.mean(-2), x.std(-2).clamp_min(1e-6)
    z = ((x - mean.unsqueeze(-2)) / std.unsqueeze(-2)).clamp(-FAR, FAR)
    used = torch.cat([relevant, torch.ones_like(motion[..., 0, :], dtype=torch.bool)], -1)
    z = torch.cat([torch.ones_like(z[..., :1]), z * used.unsqueeze(-2)], -1)

    quarters = [*zip(z.tensor_split(FOLDS, -2), missed.tensor_split(FOLDS, -2), strict=True)]
    sums = torch.stack([part.mT @ torch.cat([part, miss], -1) for part, miss in quarters], -3)
    total = sums.sum(-3, keepdim=True)
    # With each quarter left out, and last with all steps: (*L, FOLDS + 1, PENALTIES, P, D).
    weights = _ridge(torch.cat([total - sums, total], -3), z.shape[-1])

    # Squared errors of each quarter, (*L, PENALTIES, FOLDS, D), and without a residual.
    left = torch.stack(
        [
            (miss.unsqueeze(-3) - part.unsqueeze(-3) @ weights[..., k, :, :, :]).square().mean(-2)
            for k, (part, miss) in enumerate(quarters)
        ],
        -2,
    )
    alone = torch.stack([miss.square().mean(-2) for _, miss in quarters], -2)

    which = left.mean(-2).argmin(-2)  # the penalty of each coordinate
    best = torch.take_along_dim(left, which[..., None, None, :], -3).squeeze(-3)
    helps = (best < alone).all(-2)
    error = torch.where(helps, best.mean(-2), alone.mean(-2))
    fitted = torch.take_along_dim(weights[..., -1, :, :, :], which[..., None, None, :], -3)
    return {
        "mean": mean,
        "std": std,
        "weights": torch.where(helps.unsqueeze(-2), fitted.squeeze(-3), 0.0),
        "noise": error.sqrt(),
        "explained": 1 - error / alone.mean(-2).clamp_min(1e-30),
        "steps": torch.full(x.shape[:-2], x.shape[-2], device=x.device),
    }


def _ridge(sums: Tensor, size: int) -> Tensor:
    """Return the weights ``(*B, PENALTIES, P, D)`` of sums ``(*B, P, P + D)``."""
    gram, cross = sums.unsqueeze(-3).split([size, sums.shape[-1] - size], -1)
    shrink = torch.tensor(PENALTIES, dtype=sums.dtype, device=sums.device)
    shrink = shrink.unsqueeze(-1).repeat(1, size)
    shrink[:, 0] = FREE
    return torch.linalg.solve(gram + shrink.diag_embed(), cross)


@torch.no_grad()
def relevant_coordinates(
    model: DynamicsModel,
    state: Tensor,
    action: Tensor,
    distance: float = 0.1,
    coordinates: Sequence[int] | None = None,
) -> Tensor:
    """Return on which coordinates of the state the predicted motion depends, ``(*L, S)``.

    It does not on a position on flat ground, whose values the fit must not use.

    Args:
        model: the nominal model.
        state: some states, ``(*L, N, S)``.
        action: actions in them, ``(*L, N, A)``.
        distance: by which each coordinate is moved.
        coordinates: that are moved; None: all. Of the others nothing is found.

    >>> from afm_rl.dynamics import Dubins  # x, y and heading
    >>> relevant_coordinates(Dubins(), torch.zeros(5, 3), torch.ones(5, 2))
    tensor([False, False,  True])
    """
    difference = model.manifold.difference
    motion = difference(model(state, action), state)
    size = state.shape[-1]
    chosen = list(range(size)) if coordinates is None else list(coordinates)
    moved = state.unsqueeze(-2) + distance * torch.eye(size).to(state)[chosen]
    act = action.unsqueeze(-2).expand(*moved.shape[:-1], -1)
    change = (difference(model(moved, act), moved) - motion.unsqueeze(-2)).abs()
    smallest = 1e-6 * motion.abs().mean(-2, keepdim=True).clamp_min(1e-9)
    if state.dtype != torch.float64:
        smallest = smallest + 8 * torch.finfo(state.dtype).eps * state.abs().amax()
    found = torch.zeros_like(state[..., 0, :], dtype=torch.bool)
    found[..., chosen] = (change > smallest.unsqueeze(-2)).any(-1).any(-2)
    return found
