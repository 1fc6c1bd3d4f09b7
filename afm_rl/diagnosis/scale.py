"""A log in units in which all actuators are alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from afm_rl.diagnosis.log import Log


@dataclass(frozen=True)
class Scaled:
    """A log in half ranges of commands and standard deviations of responses.

    Args:
        raw: in the units that it was written in.
        log: in units of ``reach`` and ``spread``.
        reach: half range of each command, ``(A,)``; 1 if it does not change.
        spread: standard deviation of each response, ``(A,)``.
    """

    raw: Log
    log: Log
    reach: np.ndarray
    spread: np.ndarray


def scale(log: Log) -> Scaled:
    """Return a log in units in which all actuators are alike."""
    low, high = ends_of(log.command)
    reach, spread = np.where(high > low, 0.5 * (high - low), 1.0), _spread(log.response)
    alike = replace(log, command=log.command / reach, response=log.response / spread)
    return Scaled(log, alike, reach, spread)


def ends_of(command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lowest and highest commands, ``(A,)``, but for one row in a hundred at each end.

    All rows count where a command hardly moves otherwise.
    """
    low, high = np.quantile(command, [0.01, 0.99], axis=0)
    rare = high - low < 0.1 * np.ptp(command, axis=0)
    return np.where(rare, command.min(0), low), np.where(rare, command.max(0), high)


def middle_of(command: np.ndarray) -> float:
    """Return the middle of a command, 0 if it comes near 0."""
    low, high = (float(end[0]) for end in ends_of(command[:, None]))
    near = 0.1 * (high - low)
    return 0.0 if low - near <= 0.0 <= high + near else 0.5 * (low + high)


def _spread(response: np.ndarray) -> np.ndarray:
    """Return a standard deviation of each response that outliers hardly change, ``(A,)``."""
    low, high = np.quantile(response, [0.02, 0.98], axis=0)
    spread = np.clip(response, low, high).std(0)
    spread = np.where(spread > 0, spread, response.std(0))
    return np.where(spread > 1e-12 * (1e-300 + np.abs(response).max(0)), spread, 1.0)
