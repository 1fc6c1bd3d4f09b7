"""Systems of a few linear equations, with a positive definite matrix.

A function that is being exported has them written out, so that they become part of the compiled
loops (a call of LAPACK takes longer than everything around it), or of a graph that has no LAPACK.
"""

from __future__ import annotations

import torch
from torch import Tensor

from afm_rl.compiling.tracing import none_holds

ROUNDING = 100.0  # units in the last place by which rounding may move a matrix


def solve_positive(matrix: Tensor, right: Tensor) -> Tensor:
    r"""Return :math:`X = A^{-1} B`.

    Args:
        matrix: A, ``(*B, N, N)``.
        right: B, ``(*B, N, M)``.

    >>> solve_positive(torch.tensor([[2.0, 1.0], [1.0, 3.0]]), torch.tensor([[3.0], [4.0]]))
    tensor([[1.],
            [1.]])
    """
    if torch.compiler.is_compiling():
        return eliminate(matrix, right)
    return torch.linalg.solve_ex(matrix, right).result


def invert_positive(matrix: Tensor) -> Tensor:
    r"""Return :math:`A^{-1}` of ``(*B, N, N)``.

    A matrix that is positive definite but for rounding counts as one with a larger diagonal.

    >>> invert_positive(torch.tensor([[2.0, 1.0], [1.0, 3.0]]))
    tensor([[ 0.6000, -0.2000],
            [-0.2000,  0.4000]])
    """
    if torch.compiler.is_compiling():
        return eliminate(matrix, torch.eye(matrix.shape[-1]).to(matrix).expand_as(matrix))
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if not none_holds(failed):
        share = ROUNDING * torch.finfo(matrix.dtype).eps
        larger = torch.where(failed > 0, share, 0.0).to(matrix)[..., None]
        diagonal = torch.diag_embed(larger * matrix.diagonal(dim1=-2, dim2=-1))
        factor = torch.linalg.cholesky_ex(matrix + diagonal).L
    return torch.cholesky_inverse(factor)


def add_diagonal(matrix: Tensor, value: float) -> Tensor:
    """Return matrices ``(*B, N, M)`` with ``value`` added to their diagonals.

    >>> add_diagonal(torch.zeros(2, 3), 1.0)
    tensor([[1., 0., 0.],
            [0., 1., 0.]])
    """
    if torch.compiler.is_compiling():
        return matrix + value * torch.eye(*matrix.shape[-2:]).to(matrix)
    moved = matrix.clone()  # a unit matrix is nine operations
    moved.diagonal(dim1=-2, dim2=-1).add_(value)
    return moved


def eliminate(matrix: Tensor, right: Tensor) -> Tensor:
    """Return :math:`A^{-1} B` by Gauss-Jordan elimination, which needs no other pivots here.

    Against rounding, no pivot is smaller than a small share of its diagonal entry.

    >>> eliminate(torch.tensor([[2.0, 1.0], [1.0, 3.0]]), torch.tensor([[3.0], [4.0]]))
    tensor([[1.],
            [1.]])
    """
    size, rows = matrix.shape[-1], torch.cat([matrix, right], -1)
    share = 0.1 * ROUNDING * torch.finfo(matrix.dtype).eps
    least = share * matrix.diagonal(dim1=-2, dim2=-1)[..., None]
    for k in range(size):
        (pivot, row), (below, rest) = (
            part.split([1, part.shape[-1] - 1], -1) for part in rows.split([1, size - 1], -2)
        )
        row = row / pivot.maximum(least[..., k : k + 1, :])
        rows = torch.cat([rest - below * row, row], -2)
    return rows
