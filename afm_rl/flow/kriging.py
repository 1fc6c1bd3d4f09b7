"""What was seen corrects what is foreseen: kriging, with the network's guess for its mean."""

from __future__ import annotations

import torch
from torch import Tensor

NOISE = 0.1  # of what was seen, relative to how far the network is expected to be off


def krige(asked: Tensor, tried: Tensor, missed: Tensor, valid: Tensor, scale: float) -> Tensor:
    r"""Return by how much to correct what was foreseen for actions ``(*B, P, A)``.

    Gaussian process regression of the misses r of a guess: near an action that was tried the
    guess is made to agree with what was seen, far from all of them it stays as it is.

    .. math:: \hat{r}(u) = k(u, U)\,(k(U, U) + \sigma^2 I)^{-1} r,\qquad
              k(u, u') = e^{-\|u - u'\|^2 / 2 \ell^2}

    Args:
        asked: actions u, ``(*B, P, A)``.
        tried: actions U whose effects were seen, ``(*B, K, A)``.
        missed: r, by how much the guess was off there, ``(*B, K, D)``.
        valid: which of them count, ``(*B, K, 1)``, 0 or 1.
        scale: the length scale, in the unit of actions.

    >>> tried, missed, valid = torch.tensor([[0.5]]), torch.tensor([[1.0]]), torch.ones(1, 1)
    >>> krige(torch.tensor([[0.5], [0.7], [-0.5]]), tried, missed, valid, 0.2)
    tensor([[9.9010e-01],
            [6.0053e-01],
            [3.6898e-06]])
    """
    # A row that does not count is alone in the world: k = 0 but with itself, and no miss.
    counts = valid * valid.mT
    gram = _kernel(tried, tried, scale) * counts
    own = (NOISE**2 + 1 - valid.squeeze(-1)).diag_embed()
    weights = torch.linalg.solve(gram + own, missed * valid)
    return _kernel(asked, tried, scale) @ (weights * valid)


def _kernel(left: Tensor, right: Tensor, scale: float) -> Tensor:
    apart = (left.unsqueeze(-2) - right.unsqueeze(-3)) / scale
    return (-0.5 * apart.square().sum(-1)).exp()
