"""Systems of a few linear equations, with a positive definite matrix.

A function that is being exported has up to five equations written out, so that they become part of
the compiled loops: a call of LAPACK takes longer than everything around it.
"""

from __future__ import annotations

import torch
from torch import Tensor

FEW = 5


def solve_positive(matrix: Tensor, right: Tensor) -> Tensor:
    r"""Return :math:`X = A^{-1} B`.

    Args:
        matrix: A, ``(*B, N, N)``.
        right: B, ``(*B, N, M)``.

    >>> solve_positive(torch.tensor([[2.0, 1.0], [1.0, 3.0]]), torch.tensor([[3.0], [4.0]]))
    tensor([[1.],
            [1.]])
    """
    if _written_out(matrix):
        return eliminate(matrix, right)
    return torch.linalg.solve_ex(matrix, right).result


def invert_positive(matrix: Tensor) -> Tensor:
    r"""Return :math:`A^{-1}` of ``(*B, N, N)``.

    >>> invert_positive(torch.tensor([[2.0, 1.0], [1.0, 3.0]]))
    tensor([[ 0.6000, -0.2000],
            [-0.2000,  0.4000]])
    """
    if _written_out(matrix):
        return eliminate(matrix, torch.eye(matrix.shape[-1]).to(matrix))
    return torch.cholesky_inverse(torch.linalg.cholesky_ex(matrix).L)


def _written_out(matrix: Tensor) -> bool:
    return torch.compiler.is_compiling() and matrix.shape[-1] <= FEW


def add_diagonal(matrix: Tensor, value: float) -> Tensor:
    """Return matrices ``(*B, N, M)`` with ``value`` added to their diagonals, in place.

    >>> add_diagonal(torch.zeros(2, 3), 1.0)
    tensor([[1., 0., 0.],
            [0., 1., 0.]])
    """
    matrix.diagonal(dim1=-2, dim2=-1).add_(value)
    return matrix


def eliminate(matrix: Tensor, right: Tensor) -> Tensor:
    """Return :math:`A^{-1} B` by Gaussian elimination, which needs no pivots here.

    >>> eliminate(torch.tensor([[2.0, 1.0], [1.0, 3.0]]), torch.tensor([[3.0], [4.0]]))
    tensor([[1.],
            [1.]])
    """
    rows = [list(row.unsqueeze(-1).unbind(-2)) for row in matrix.unbind(-2)]
    sides, size = list(right.unbind(-2)), matrix.shape[-1]
    for k in range(size):
        for i in range(k + 1, size):
            factor = rows[i][k] / rows[k][k]
            for j in range(k + 1, size):
                rows[i][j] = rows[i][j] - factor * rows[k][j]
            sides[i] = sides[i] - factor * sides[k]
    for k in reversed(range(size)):
        for j in range(k + 1, size):
            sides[k] = sides[k] - rows[k][j] * sides[j]
        sides[k] = sides[k] / rows[k][k]
    return torch.stack(sides, -2)
