"""Lines by least squares, kept away from what the rows cannot tell."""

from __future__ import annotations

import numpy as np


def ridge(gram: np.ndarray, cross: np.ndarray, share: float) -> np.ndarray:
    r"""Return :math:`(G + s\,\mathrm{tr}(G) I)^{-1} c`, of matrices ``(*B, P, P)``; 0 of none.

    >>> ridge(np.array([[2.0]]), np.array([4.0]), 0.0), ridge(np.zeros((1, 1)), np.zeros(1), 0.1)
    (array([2.]), array([0.]))
    """
    trace = np.trace(gram, axis1=-2, axis2=-1)[..., None, None]
    return np.linalg.solve(gram + (share * trace + 1e-300) * np.eye(gram.shape[-1]), cross)


def with_one(*columns: np.ndarray) -> np.ndarray:
    """Return columns, each ``(N,)`` or ``(N, K)``, and one of ones, ``(N, P)``.

    >>> with_one(np.array([2.0, 3.0])).tolist()
    [[2.0, 1.0], [3.0, 1.0]]
    """
    return np.column_stack([*columns, np.ones(len(columns[0]))])


def best_line(design: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the weights ``(P, ...)`` by which columns ``(N, P)`` come nearest to ``(N, ...)``."""
    return np.linalg.lstsq(design, y, rcond=None)[0]


def left_by(design: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return what the best lines ``(N, P)`` leave of values ``(N, ...)``."""
    return y - design @ best_line(design, y)


def missed(x: np.ndarray, y: np.ndarray, share: float, folds: int = 20) -> float:
    """Return the squared error of lines ``(N, P)``: each half of the rows by the other half."""
    first = np.arange(len(y)) * folds // len(y) % 2 == 0
    total = 0.0
    for test in (first, ~first):
        own = x[~test]
        line = ridge(own.T @ own, own.T @ y[~test], share / x.shape[1])
        total += float(((y - x @ line)[test] ** 2).sum())
    return total
