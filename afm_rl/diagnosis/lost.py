"""Rows in which an actuator does not follow, now and then: slip, drop-outs, loose contacts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.log import GAP, Log
from afm_rl.diagnosis.model import scale_of
from afm_rl.diagnosis.parts import find_parts, predict
from afm_rl.diagnosis.pattern import hats, predictable
from afm_rl.diagnosis.response import Shape, respond
from afm_rl.diagnosis.search import Lead

UNEXPLAINED = 0.004  # share of the variance: lines that leave less leave nothing to look for
KEPT = 0.55  # share of the rows to which a line is fitted, those that it fits best
ROUNDS = 15  # of that
FAR = 5.0  # standard deviations of the others: rows that are as far from the line are lost
SHARES = 0.006, 0.45  # of lost rows
BLOCKS, TOUCHED = 8, 5  # of the log, and how many of them must have lost rows
BETTER = 0.35  # times what the best explanation of all rows leaves
BY_COMMAND = 0.3  # share of the losses that the command may predict


def without_lost(log: Log, j: int, lead: Lead, repeats: bool) -> tuple[Log, float]:
    """Return the log with one response as it would be if it always followed, and the share lost.

    A line is fitted to the rows that it fits best (least trimmed squares). The others are lost if
    they are all over the log and at all commands, and if no explanation of all rows comes near,
    nor any of its parts.

    Args:
        log: scaled.
        j: number of the actuator.
        lead: where its explanation begins.
        repeats: are rows lost that repeat the last response, too?
    """
    if lead.left < UNEXPLAINED:
        return log, 0.0
    clock = lead.clock_of(log)
    place = clock.places(lead.delay).astype(int)
    after = np.minimum(place + 1, len(place) - 1)
    known = clock.time[after] - clock.time[place] < GAP
    x = respond(clock, log.command[:, lead.driver], Shape(lead.delay, lead.keep))
    design, y = np.column_stack([x, np.ones(len(x))]), log.response[:, j]
    if repeats:
        known &= np.diff(y, prepend=np.inf) != 0
    chosen = known
    for _ in range(ROUNDS):
        line = design @ np.linalg.lstsq(design[chosen], y[chosen], rcond=None)[0]
        far = np.abs(y - line)
        chosen = known & (far <= np.quantile(far[known], KEPT))
    for _ in range(2):
        chosen = known & (far <= FAR * scale_of(far[chosen]))
        line = design @ np.linalg.lstsq(design[chosen], y[chosen], rcond=None)[0]
        far = np.abs(y - line)
    residual = (y - line)[chosen]
    lost = far > max(FAR * scale_of(residual), 1e-9)
    share = float(lost.mean())
    blocks = np.array([block.mean() for block in np.array_split(lost, BLOCKS)])
    if not SHARES[0] < share < SHARES[1] or (blocks > 0.2 * share).sum() < TOUCHED:
        return log, 0.0
    if predictable(hats(x), lost - share) > BY_COMMAND:
        return log, 0.0
    best = y.copy()
    for part in find_parts(log, j, lead):
        rows = slice(part.first, part.last)
        best[rows] -= predict(log, j, part)[rows]
    if residual.std() > BETTER * best.std():
        return log, 0.0
    response = log.response.copy()
    drawn = np.random.default_rng(0).choice(residual, int(lost.sum()))
    response[lost, j] = line[lost] + drawn
    return replace(log, response=response), share
