"""Frames that were not recorded, or recorded again: what a data set lacks."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def frozen_rows(
    command: np.ndarray, response: np.ndarray, border: np.ndarray, delay: int = 10
) -> np.ndarray:
    """Return how long responses stand still while commands move, in rows ``(N,)``; 0 elsewhere.

    They stand still where all are exactly those of the row before; commands move by a fiftieth of
    their ranges meanwhile, in longer stretches by a tenth: friction holds a robot back, too. A
    robot at rest waits for its commands, for up to ``delay`` rows.

    Args:
        command: ``(N, A)``.
        response: ``(N, A)``.
        border: number of the episode of each row, ``(N,)``, ascending.
        delay: the longest one (rows).

    >>> u, y = np.arange(8.0)[:, None], np.array([0, 1, 2, 2, 2, 2, 3, 4.0])[:, None]
    >>> frozen_rows(u, y, np.zeros(8, dtype=int))
    array([0, 0, 0, 3, 3, 3, 0, 0])
    """
    still = np.zeros(len(border), dtype=bool)
    still[1:] = (response[1:] == response[:-1]).all(1) & (border[1:] == border[:-1])
    edges = np.flatnonzero(np.diff(np.r_[0, still.astype(int), 0]))
    ranges = np.maximum(np.ptp(command, axis=0), 1e-300)
    length = np.zeros(len(border), dtype=int)
    for first, last in edges.reshape(-1, 2):
        begins = first < 2 or border[first - 2] < border[first]
        before = command[first - 1 : max(last - delay, first + 1)]  # moves that must have acted
        waits = begins and last - first <= delay
        share = 0.02 if last - first <= delay else 0.1
        if not waits and (np.ptp(before, axis=0) > share * ranges).any():
            length[first:last] = last - first
    return length


def frozen_episodes(length: np.ndarray, border: np.ndarray, longest: float) -> list[int]:
    """Return the numbers of the episodes whose responses are frozen, by :func:`frozen_rows`.

    That is, for more than ``longest`` rows, which no robot waits, or half of the episode, and ten
    rows at least. Where all are, the robot does not move, and none is left out.

    >>> frozen_episodes(np.repeat([0, 40], 40), np.repeat([0, 1], 40), longest=30)
    [1]
    """
    numbers, sizes = np.unique(border, return_counts=True)
    most = np.zeros(len(numbers), dtype=int)
    np.maximum.at(most, np.searchsorted(numbers, border), length)
    odd = most >= np.maximum(np.minimum(longest, 0.5 * sizes), 10)
    return [] if odd.all() else [int(number) for number in numbers[odd]]


def listed(numbers: Iterable[int], most: int = 12) -> str:
    """Return numbers as text, neighbours as one.

    >>> listed([1, 2, 3, 7, 9, 10])
    '1 to 3, 7, 9, 10'
    """
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    texts = []
    for run in runs:
        texts += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else [str(number) for number in run]
    return ", ".join(texts[:most]) + (", ..." if len(texts) > most else "")
