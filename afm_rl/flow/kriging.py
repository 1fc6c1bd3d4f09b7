"""What was seen corrects what is foreseen: kriging, with the network's guess for its mean."""

from __future__ import annotations

import torch
from torch import Tensor

LEAST = 1e-3  # half ranges: actions that are smaller still are all one
NOISE = 0.1  # of what was seen, relative to how far the network is expected to be off


def krige(asked: Tensor, tried: Tensor, missed: Tensor, valid: Tensor, share: float) -> Tensor:
    r"""Return by how much to correct what was foreseen for actions ``(*B, P, A)``.

    Gaussian process regression of the misses r of a guess: near an action that was tried the
    guess is made to agree with what was seen, far from all of them it stays as it is.

    .. math:: \hat{r}(u) = k(u, U)\,(k(U, U) + \sigma^2 I)^{-1} r,\qquad
              k(u, u') = e^{-\|u - u'\|^2 / 2 \ell^2}

    The length scale :math:`\ell` is a share of the largest action that was tried: where all
    actions are small, small differences count.

    Args:
        asked: actions u, ``(*B, P, A)``.
        tried: actions U whose effects were seen, ``(*B, K, A)``.
        missed: r, by how much the guess was off there, ``(*B, K, D)``.
        valid: which of them count, ``(*B, K, 1)``, 0 or 1.
        share: :math:`\ell` relative to the largest component of U that counts.

    >>> tried, missed, valid = torch.tensor([[1.0]]), torch.tensor([[1.0]]), torch.ones(1, 1)
    >>> krige(torch.tensor([[1.0], [1.2], [0.0]]), tried, missed, valid, 0.2)
    tensor([[9.9010e-01],
            [6.0053e-01],
            [3.6898e-06]])
    """
    largest = (tried.abs() * valid).amax((-2, -1)).clamp_min(LEAST)[..., None, None]
    # A row that does not count is alone in the world: k = 0 but with itself, and no miss.
    counts = valid * valid.mT
    asked, tried = asked / largest, tried / largest
    gram = _kernel(tried, tried, share) * counts
    own = (NOISE**2 + 1 - valid.squeeze(-1)).diag_embed()
    weights = torch.linalg.solve(gram + own, missed * valid)
    return _kernel(asked, tried, share) @ (weights * valid)


def _kernel(left: Tensor, right: Tensor, scale: float) -> Tensor:
    apart = (left.unsqueeze(-2) - right.unsqueeze(-3)) / scale
    return (-0.5 * apart.square().sum(-1)).exp()
