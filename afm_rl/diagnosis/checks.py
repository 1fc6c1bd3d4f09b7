"""What a log cannot tell: commands that do not move, responses that nobody measured or caused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.findings import Status
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.search import Lead, find_leads, without_outliers
from afm_rl.diagnosis.settings import Settings

Doubt = tuple[Status, str]
COPY = 0.999  # correlation of two commands that cannot be told apart


def find_doubts(
    log: Log, leads: Sequence[Lead], settings: Settings, exact: Sequence[bool]
) -> dict[int, Doubt]:
    """Return why nothing can be said of some actuators, by number.

    Args:
        log: scaled.
        leads: of the actuators.
        settings: is a response that equals its command a copy?
        exact: is the response of an actuator its command in every row?
    """
    doubts: dict[int, Doubt] = {}
    summed = _summed(log, leads, settings)
    for j, lead in enumerate(leads):
        u, y = log.command[:, j], log.response[:, j]
        if not np.ptp(u) > 0:
            doubts[j] = "cannot tell", "its command does not change; move it"
        elif exact[j] and settings.echo:
            doubts[j] = (
                "not measured",
                "its response is its command, digit by digit; log what a sensor reads",
            )
        elif lead.left > 0.6 and _causes(log, y, u) and not _causes(log, u, y):
            doubts[j] = (
                "not actuated",
                "its command answers its response, and not the other way round; is it armed?",
            )
        elif j in summed:
            doubts[j] = (
                "cannot tell",
                "its response moves as if it added up its command; log its rate of change",
            )
    return doubts


def echoes(log: Log, rows: Sequence[int] = (0, 1)) -> list[bool]:
    """Return which responses are exactly their commands, of the same row or of the one before."""
    apart = np.cumsum(log.begins)
    found = np.zeros(len(log.names), dtype=bool)
    for late in rows:
        u, y = log.command[: len(apart) - late], log.response[late:]
        same = apart[late:] == apart[: len(apart) - late]
        found |= (u == y)[same].all(0)
    return list(found & (np.ptp(log.command, axis=0) > 0))


def copies_of(command: np.ndarray) -> list[list[int]]:
    """Return for each command the others that are the same up to a factor."""
    u = command - command.mean(0)
    power = np.sqrt((u**2).sum(0))
    alike = np.abs(u.T @ u) / np.maximum(np.outer(power, power), 1e-300)
    np.fill_diagonal(alike, 0.0)
    return [[int(i) for i in np.flatnonzero(row > COPY)] for row in alike]


def _causes(log: Log, cause: np.ndarray, effect: np.ndarray, past: int = 8) -> bool:
    """Return whether the past of one series predicts another beyond its own past (Granger 1969).

    A tenth of what the own past leaves must be predicted in rows that were held out, with the past
    8 rows or each fifth of the past 40.
    """
    place = np.arange(len(effect)) - np.maximum.accumulate(
        np.where(log.begins, np.arange(len(effect)), 0)
    )
    shares = []
    for every in (1, 5):
        rows = np.flatnonzero(place >= past * every)
        if len(rows) < 20 * past:
            continue
        late = np.arange(1, past + 1) * every
        own, other = (series[rows[:, None] - late] for series in (effect, cause))
        alone = np.column_stack([np.ones(len(rows)), own])
        test = np.arange(len(rows)) * 20 // len(rows) % 2 == 0
        missed = [
            sum(_missed(x, effect[rows], some) for some in (test, ~test))
            for x in (alone, np.column_stack([alone, other]))
        ]
        shares.append(1 - missed[1] / max(missed[0], 1e-300))
    return max(shares, default=0.0) > 0.1


def _missed(x: np.ndarray, y: np.ndarray, test: np.ndarray) -> float:
    """Return the squared error in some rows of lines that are fitted to the others."""
    gram = x[~test].T @ x[~test]
    gram += 1e-9 * gram.trace() / len(gram) * np.eye(len(gram))
    line = np.linalg.solve(gram, x[~test].T @ y[~test])
    return float(((y - x @ line)[test] ** 2).sum())


def _summed(log: Log, leads: Sequence[Lead], settings: Settings) -> set[int]:
    """Return the actuators whose responses do not follow, but change as the commands say."""
    odd = [j for j, lead in enumerate(leads) if lead.left > 0.1]
    if not odd:
        return set()
    rates = np.diff(log.response, axis=0, prepend=log.response[:1])
    rates[log.begins] = 0.0
    spread = without_outliers(rates).std(0)
    changes = replace(log, response=rates / np.where(spread > 0, spread, 1.0))
    found = find_leads(changes.thinned(settings.searched), odd, settings)
    return {
        j
        for j, rate in zip(odd, found, strict=True)
        if rate.left < 0.3 * leads[j].left and rate.driver == j
    }
