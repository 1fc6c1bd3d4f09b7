"""Rows in which an actuator does not follow, now and then: slip, drop-outs, loose contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.changes import Part
from afm_rl.diagnosis.log import GAP, Log
from afm_rl.diagnosis.pattern import hats, predictable
from afm_rl.diagnosis.response import respond
from afm_rl.diagnosis.search import Lead, beginning


def without_lost(
    log: Log, j: int, lead: Lead, parts: Sequence[Part], repeats: bool, apart: float = 5.0
) -> tuple[Log, float]:
    """Return the log with one response as it would be if it always followed, and the share lost.

    A line is fitted to the rows that it fits best (least trimmed squares), behind the delay, lag
    and rate limit that leave least. The other rows are lost if they are all over the log, if
    neither the command nor its last moves predict which they are, and if no explanation of all
    rows comes near.

    Args:
        log: scaled.
        j: number of the actuator.
        lead: where its explanation begins.
        parts: the explanations of all rows.
        repeats: are rows lost that repeat the last response, too?
        apart: standard deviations of the others: rows that are as far from the line are lost.
    """
    y, clock = log.response[:, j], lead.clock_of(log)
    best = y - y.mean()
    for part in parts:
        best[part.rows] = (y - part.predict(log, j))[part.rows]
    if lead.left < 0.004 or best.std() < 0.05 * y.std():  # nothing to look for
        return log, 0.0
    u, begin = log.command[:, lead.driver], None
    if lead.line is not None:
        begin = beginning(clock, u, y, lead.line)
    known = np.ones(len(y), dtype=bool)
    if repeats:
        known &= np.diff(y, prepend=np.inf) != 0
    options = []
    for shape in lead.starts:
        place = clock.places(shape.delay).astype(int)
        near = clock.time[np.minimum(place + 1, len(y) - 1)] - clock.time[place] < GAP
        x = respond(clock, u, shape, begin)
        options.append(_trimmed(np.column_stack([x, np.ones(len(y))]), y, known & near, apart))
    line, chosen = min(options, key=lambda option: np.abs(y - option[0])[option[1]].mean())
    far = np.abs(y - line)
    residual = (y - line)[chosen]
    lost = far > max(apart * _scale(residual), 1e-9)
    share = float(lost.mean())
    blocks = np.array([block.mean() for block in np.array_split(lost, 8)])
    if not 0.006 < share < 0.45 or (blocks > 0.2 * share).sum() < 5:
        return log, 0.0
    late = clock.places(max(shape.delay for shape in lead.starts)).astype(int)
    moves = [hats(np.abs(u - u[np.maximum(late - k, clock.start)])) for k in (2, 8, 20)]
    since = hats(np.minimum(np.arange(len(y)) - clock.start, 100.0))  # what was before is not known
    if predictable(np.column_stack([hats(u[late]), since, *moves]), lost - share) > 0.25:
        return log, 0.0
    explained = (best[lost] ** 2).mean() < 0.3 * (far[lost] ** 2).mean()
    if explained or residual.std() > 0.35 * best.std():
        return log, 0.0
    response = log.response.copy()
    drawn = np.random.default_rng(0).choice(residual, int(lost.sum()))
    response[lost, j] = line[lost] + drawn
    return replace(log, response=response), share


def _trimmed(
    design: np.ndarray, y: np.ndarray, known: np.ndarray, apart: float, kept: float = 0.55
) -> tuple[np.ndarray, np.ndarray]:
    """Return the line through the share of rows that it fits best, and which rows are near it."""
    chosen = known
    for _ in range(15):
        line = design @ np.linalg.lstsq(design[chosen], y[chosen], rcond=None)[0]
        far = np.abs(y - line)
        chosen = known & (far <= np.quantile(far[known], kept))
    for _ in range(2):
        chosen = known & (far <= apart * _scale(far[chosen]))
        line = design @ np.linalg.lstsq(design[chosen], y[chosen], rcond=None)[0]
        far = np.abs(y - line)
    return line, chosen


def _scale(residual: np.ndarray) -> float:
    """Return the standard deviation of residuals, whatever half of them is."""
    return float(np.median(np.abs(residual))) / 0.6745
