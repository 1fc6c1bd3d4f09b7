"""What an engineer would predict a command to do, from the rows before it: the bars to clear.

Each predictor takes commands and responses ``(N, A)``, and before which rows the command is not
known ``(N,)``. It returns predictions ``(N, A)``; that of a row depends on its own command and on
earlier rows only.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.signal import lfilter

Predictor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def as_commanded(command: np.ndarray, response: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Return the command itself: nothing is corrected.

    >>> as_commanded(np.ones((2, 1)), np.zeros((2, 1)), np.zeros(2, bool)).tolist()
    [[1.0], [1.0]]
    """
    return command.copy()


def running_gain(
    command: np.ndarray, response: np.ndarray, begins: np.ndarray, rows: int = 12
) -> np.ndarray:
    r"""Return :math:`g_k u_k` with :math:`g_k = \sum u y / \sum u^2` over the last rows.

    >>> u = np.array([[1.0], [2.0], [3.0]])
    >>> running_gain(u, -u, np.zeros(3, bool)).round(6).tolist()  # reversed: row 0 cannot know
    [[1.0], [-2.0], [-3.0]]
    """
    window = np.r_[0.0, np.ones(rows)]
    # Until something was commanded, the gain is 1.
    small = 1e-12 * np.maximum.accumulate(np.square(command).clip(1e-30))
    both = lfilter(window, 1.0, command * response, axis=0) + small
    return command * both / (lfilter(window, 1.0, np.square(command), axis=0) + small)


def affine(
    command: np.ndarray, response: np.ndarray, begins: np.ndarray, forgetting: float = 0.95
) -> np.ndarray:
    """Return least squares of each response by all commands and one, older rows forgotten.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    >>> y = u @ np.array([[0.5, 0.2], [0.0, -1.0]]) + 0.3
    >>> bool(np.abs(affine(u, y, np.zeros(len(u), bool)) - y)[20:].max() < 0.03)
    True
    """
    size = command.shape[1]
    columns = [np.c_[command, np.ones(len(command))]] * size
    return _least_squares(columns, command, response, np.eye(size, size + 1), forgetting)


def arx(
    command: np.ndarray, response: np.ndarray, begins: np.ndarray, forgetting: float = 0.95
) -> np.ndarray:
    r"""Return :math:`y_k = a y_{k-1} + b u_k + c u_{k-1} + d` by least squares, per actuator.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (80, 1))
    >>> y = lfilter([0.5], [1.0, -0.5], u, axis=0)  # a lag
    >>> bool(np.abs(arx(u, y, np.zeros(len(u), bool)) - y)[40:].max() < 0.03)
    True
    """
    # Before a border the command is supposed to have been there, and obeyed.
    first = begins | (np.arange(len(command)) == 0)
    u0, y0 = (
        np.where(first[:, None], command, np.roll(part, 1, axis=0)) for part in (command, response)
    )
    one = np.ones(len(command))
    columns = [np.c_[u, *past, one] for u, *past in zip(command.T, u0.T, y0.T, strict=True)]
    prior = np.eye(4)[[0] * len(columns)]
    return _least_squares(columns, command, response, prior, forgetting, first)


SIMPLE: dict[str, Predictor] = {
    "as commanded": as_commanded,
    "gain of 3 rows": partial(running_gain, rows=3),
    "gain of 12 rows": running_gain,
    "affine least squares": affine,
    "ARX": arx,
}
"""The simple predictors, by name."""


def _least_squares(
    columns: list[np.ndarray],
    command: np.ndarray,
    response: np.ndarray,
    prior: np.ndarray,
    forgetting: float,
    skipped: np.ndarray | None = None,
    ridge: float = 0.1,
) -> np.ndarray:
    """Return each actuator's prediction by its columns ``(N, F)``, fitted to earlier rows."""
    earlier = partial(lfilter, [0.0, 1.0], [1.0, -forgetting], axis=0)
    found = np.empty_like(command)
    for j, x in enumerate(columns):
        mean = np.square(x).cumsum(0) / np.arange(1, len(x) + 1)[:, None]  # of rows so far
        weight = ridge * mean.clip(1e-100)
        told = x if skipped is None else x * ~skipped[:, None]
        gram = earlier(told[:, :, None] * told[:, None, :])
        gram += weight[:, :, None] * np.eye(x.shape[1])
        miss = response[:, j] - x @ prior[j]
        change = np.linalg.solve(gram, earlier(told * miss[:, None])[..., None])[..., 0]
        found[:, j] = (x * (prior[j] + change)).sum(1)
    return found
