"""Parts of a log in which an actuator stayed as it was."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from afm_rl.diagnosis.fit import FLOOR, PENALTY, fit_response, larger
from afm_rl.diagnosis.intervals import half_widths, independence
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.model import (
    Model,
    Problem,
    interval_widths,
    mean_cost,
    refine,
    scale_of,
    values_of,
    weight_of,
)
from afm_rl.diagnosis.response import Shape, lagging, look_back
from afm_rl.diagnosis.search import Lead, find_leads
from afm_rl.diagnosis.words import MATTERS, SURE

SEARCHED, SHAPED, FITTED = 4000, 3000, 12000  # rows that a step looks at, at most
BLOCKS = 60  # of a log: changes are looked for at their borders first
SHORTEST = 40  # rows of a part
PARTS = 6  # at most
PLAUSIBLE = 4.0  # twice the logarithm of the likelihood that another explanation may lack
DOUBTFUL = 6.0  # less for each number more
UNCLEAR = 0.03  # share of the variance: a model that leaves more may mix several
STEADY = 1.05  # times the squared residual of a sudden change: a drift explains it as well


@dataclass(frozen=True)
class Part:
    """A part of a log, and what explains one response in it.

    Args:
        first: its first row.
        last: the row after its last one.
        lead: where the search began.
        model: what explains it, in the units of a scaled log.
        weight: how many independent rows a row counts as.
        drift: change of gain and offset from begin to end, both 0 if there is none.
    """

    first: int
    last: int
    lead: Lead
    model: Model
    weight: float
    drift: tuple[float, float] = (0.0, 0.0)

    @property
    def rows(self) -> int:
        """Count the rows."""
        return self.last - self.first


def problem_of(log: Log, j: int, lead: Lead) -> Problem:
    """Return the problem of one response; rows at the begin of an episode do not count."""
    clock = lead.clock_of(log)
    warm = abs(lead.delay) + 1
    if lead.keep:
        warm += min(3 / -math.log(lead.keep), 0.05 * len(log.command))
    use = np.arange(len(log.command)) - clock.start >= warm
    return Problem(clock, log.command, log.response[:, j], use if use.mean() > 0.3 else use | True)


def find_parts(log: Log, j: int, lead: Lead) -> list[Part]:
    """Return the parts of a scaled log in which one response has one explanation each.

    The log is split in two where two explanations are clearly better than one and differ by more
    than 5 % of the response; then each part in the same way. A change little by little is one
    part with a drift.
    """
    parts = _divide(log, j, fit_part(log, j, 0, len(log.command), lead), PARTS)
    for k in range(len(parts) - 1 if len(parts) > 2 else 0):  # borders, now that no part is mixed
        left, right = parts[k : k + 2]
        row = _exact_row(log, j, left, right, 0.5)
        if abs(row - left.last) > 1:
            parts[k] = fit_part(log, j, left.first, row)
            parts[k + 1] = fit_part(log, j, row, right.last)
    return parts


def fit_part(log: Log, j: int, first: int, last: int, lead: Lead | None = None) -> Part:
    """Fit one response to some rows of a log."""
    rows = log.part(slice(first, last))
    if lead is None:
        (lead,) = find_leads(rows.thinned(SEARCHED), [j])
    small = problem_of(rows.thinned(SHAPED), j, lead)
    starts = [Shape(lead.delay, lead.keep)]
    if lead.keep:
        starts.append(Shape(lead.delay + 0.5 / -math.log(lead.keep)))
    model = fit_response(small, lead.driver, starts).led_by(j)
    weight = weight_of(small, model)
    if len(rows.command) > SHAPED:
        model = refine(problem_of(rows.thinned(FITTED), j, lead), model)
    return Part(first, last, lead, model, weight)


def _divide(log: Log, j: int, whole: Part, most: int) -> list[Part]:
    """Return the parts of a part."""
    if most < 2 or whole.rows < 2 * SHORTEST:
        return [whole]
    steady = _with_drift(log, j, whole)
    row = _likely_change(log, j, whole)
    if row is None:
        return [steady]
    left, right = fit_part(log, j, whole.first, row), fit_part(log, j, row, whole.last)
    for _ in range(2):
        better = _exact_row(log, j, left, right)
        if abs(better - row) < 2:
            break
        row = better
        left, right = fit_part(log, j, whole.first, row), fit_part(log, j, row, whole.last)
    apart = _apart(log, j, whole, steady, left, right)
    if not apart and whole.model.cost < UNCLEAR:
        return [steady]
    first = _divide(log, j, left, most - 1)
    found = first + _divide(log, j, right, most - len(first))
    # What changes twice may show in the parts of a part only.
    return found if apart or len(found) > 2 else [steady]


def _likely_change(log: Log, j: int, part: Part) -> int | None:
    """Return the row at which two lines are best instead of one, if that helps at all."""
    problem = problem_of(log, j, part.lead)
    rows = slice(part.first, part.last)
    shape, u = part.model.shape, log.command
    slow = lagging(problem.clock, u, shape.keep) if shape.keep else u
    linear = shape.linear
    late = [look_back(problem.clock, slow, linear)[rows]]
    own = part.model.driver
    if part.model.cost > UNCLEAR:  # a delay that is that of no part
        late.append(u[rows, own, None])
    for more in (1, 3, 8) if part.rows > 400 else ():
        later = linear._replace(delay=linear.delay + more)
        late.append(look_back(problem.clock, slow[:, own], later)[rows, None])
    late.append(part.model.parts(problem)[0][rows, None])
    if part.rows > 200 + 40 * u.shape[1]:
        design = np.column_stack(late)
    else:
        design = np.column_stack(late[1:])  # without other commands
    y = problem.y[rows]
    table = np.column_stack([design, np.ones(len(y)), y])
    size = table.shape[1]
    length = max(part.rows // BLOCKS, 5)
    count = part.rows // length
    ends = np.append(np.arange(1, count) * length, part.rows)
    sums = np.stack([block.T @ block for block in np.split(table, ends[:-1])])
    before = np.cumsum(sums, 0)[:-1]
    places = ends[:-1]
    least = max(SHORTEST, 2 * size)
    good = (places >= least) & (part.rows - places >= least)
    if not good.any():
        return None
    total = before[-1] + sums[-1]
    left = _left_over(before[good]) + _left_over(total - before[good])
    floor = FLOOR * len(y)
    gain = part.rows * np.log((_left_over(total[None])[0] + floor) / (left + floor))
    best = int(np.argmax(gain))
    weight = 1.0 if part.model.cost > UNCLEAR else part.weight
    if gain[best] * weight < PENALTY + size:
        return None
    return part.first + int(places[good][best])


def _left_over(moments: np.ndarray) -> np.ndarray:
    """Return the squared residual of lines, from moments ``(B, P, P)``, the response last."""
    gram, cross = moments[:, :-1, :-1], moments[:, :-1, -1:]
    size = gram.shape[-1]
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(size)
    solution = np.linalg.solve(gram + ridge, cross)
    return np.maximum(moments[:, -1, -1] - (solution * cross).sum((1, 2)), 0.0)


def _predictions(log: Log, j: int, *parts: Part) -> list[np.ndarray]:
    return [part.model.predict(problem_of(log, j, part.lead)) for part in parts]


def _exact_row(log: Log, j: int, left: Part, right: Part, share: float = 0.05) -> int:
    """Return the row from which on the right explanation is better."""
    rows = slice(left.first, right.last)
    y = log.response[rows, j]
    misses = [np.abs(y - p[rows]) for p in _predictions(log, j, left, right)]
    cut = 4 * min(np.median(m) for m in misses) / 0.6745 + 1e-9
    early, late = (np.minimum(m, cut) ** 2 for m in misses)
    total = np.concatenate([[0.0], np.cumsum(early - late)])
    # Close by: where one of both is a mixture itself, it may be worse wherever the other holds.
    near = max(SHORTEST // 2, int(share * len(y)))
    low = max(SHORTEST, left.rows - near)
    high = min(len(y) - SHORTEST, left.rows + near) + 1
    return left.first + low + int(total[low:high].argmin())


def _apart(log: Log, j: int, whole: Part, steady: Part, left: Part, right: Part) -> bool:
    """Return whether two explanations are clearly better than one, and differ enough to matter."""
    rows = slice(whole.first, whole.last)
    one, first, second = (p[rows] for p in _predictions(log, j, whole, left, right))
    y, use = log.response[rows, j], problem_of(log, j, whole.lead).use[rows]
    split = np.where(np.arange(len(y)) < left.rows, first, second)
    scale = scale_of((y - split)[use])
    cost = mean_cost((y - split)[use], scale) + FLOOR
    if any(steady.drift):
        drifting = mean_cost((y - one - _drifted(log, j, steady)[rows])[use], scale) + FLOOR
        if drifting < STEADY * cost:
            return False
    weight = min(independence((y - split)[use]), 0.5 + 0.5 * whole.weight)
    more = left.model.size + right.model.size + 4 - whole.model.size
    gained = len(y) * weight * math.log((mean_cost((y - one)[use], scale) + FLOOR) / cost)
    apart = min(
        float(np.sqrt(((first - second)[side][use[side]] ** 2).mean()))
        for side in (slice(left.rows), slice(left.rows, None))
        if use[side].any()
    )
    return gained > PENALTY * max(more, 2) and apart > 2 * MATTERS * split[use].std()


def _with_drift(log: Log, j: int, part: Part) -> Part:
    """Return the part with the drift of its gain and offset, if there is any that matters."""
    problem = problem_of(log, j, part.lead)
    rows = np.arange(part.first, part.last)
    rows = rows[problem.use[rows]][:: max(part.rows // FITTED, 1)]
    own = part.model.parts(problem)[0][rows]
    y, fitted = problem.y[rows], part.model.predict(problem)[rows]
    time = (rows - part.first) / part.rows - 0.5
    design = np.column_stack([own * time, time, own, np.ones(len(own))])
    residual = y - fitted
    scale = 2 * scale_of(residual)
    solution = np.zeros(4)
    for _ in range(3):
        miss = residual - design @ solution
        heavy = design / np.sqrt(1 + (miss / max(scale, 1e-9)) ** 2)[:, None]
        gram = heavy.T @ design
        gram += 1e-12 * gram.trace() * np.eye(4)
        solution = np.linalg.solve(gram, heavy.T @ residual)
    widths = SURE * half_widths((heavy * miss[:, None]) @ np.linalg.inv(gram))
    sure = np.abs(solution) > widths
    gain, offset = part.model.gain, part.model.gain
    drift = (
        float(solution[0]) if sure[0] and abs(solution[0]) > 2 * MATTERS * abs(gain) else 0.0,
        float(solution[1]) if sure[1] and abs(solution[1]) > 2 * MATTERS * abs(offset) else 0.0,
    )
    before, after = mean_cost(residual, scale / 2), mean_cost(miss, scale / 2)
    gained = len(y) * independence(miss) * math.log((before + FLOOR) / (after + FLOOR))
    return replace(part, drift=drift) if gained > 2 * PENALTY else part


def _drifted(log: Log, j: int, part: Part) -> np.ndarray:
    """Return what the drift adds to the response, ``(N,)``."""
    own = part.model.parts(problem_of(log, j, part.lead))[0]
    time = np.zeros(len(own))
    time[part.first : part.last] = np.linspace(-0.5, 0.5, part.rows)
    return (part.drift[0] * own + part.drift[1]) * time


def predict(log: Log, j: int, part: Part) -> np.ndarray:
    """Return the response that a part explains, ``(N,)``."""
    return part.model.predict(problem_of(log, j, part.lead)) + _drifted(log, j, part)


def settle(log: Log, j: int, part: Part) -> tuple[Part, Problem, np.ndarray]:
    """Return the part without its drift, fitted once more, its problem, and intervals ``(2, 2)``.

    These are of gain and offset, lowest and highest value.
    """
    if any(part.drift):
        response = log.response.copy()
        response[:, j] -= _drifted(log, j, part)
        log = replace(log, response=response)
        part = replace(fit_part(log, j, part.first, part.last, part.lead), drift=part.drift)
    problem = problem_of(log.part(slice(part.first, part.last)).thinned(FITTED), j, part.lead)
    return part, problem, _intervals(problem, part.model, part.lead)


def _intervals(problem: Problem, model: Model, lead: Lead) -> np.ndarray:
    """Return the intervals of gain and offset, ``(2, 2)``.

    They span those of every mixture of delay and lag that explains the response about as well, and
    of a model with one number more that explains it a little better: what was left out because it
    is not sure may still be there.
    """
    rows = problem.use.sum() * weight_of(problem, model)
    late = model.shape.delay
    if model.shape.keep > 0:
        late -= 1 / math.log(model.shape.keep)
    rest = tuple(name for name in model.active if name not in ("delay", "keep"))
    lag = math.exp(-1 / max(late, 0.3))
    mixed = model.shape._replace(delay=late / 2, keep=math.exp(-2 / max(late, 0.3)))
    others = (
        []
        if len(problem.y) > SHAPED
        else [
            replace(
                model, active=(*rest, "delay"), shape=model.shape._replace(delay=late, keep=0.0)
            ),
            replace(model, active=(*rest, "keep"), shape=model.shape._replace(delay=0.0, keep=lag)),
            replace(model, active=(*rest, "delay", "keep"), shape=mixed),
        ]
    )
    if len(problem.y) <= SHAPED:
        others += larger(problem, model)
    ends = []
    for found in [model, *(refine(problem, other) for other in others)]:
        lost = rows * math.log((found.cost + FLOOR) / (model.cost + FLOOR))
        if lost < PLAUSIBLE - DOUBTFUL * max(found.size - max(model.size, 1), 0):
            middle, widths = values_of(found)[:2], interval_widths(problem, found)[:2]
            ends.append([middle - widths, middle + widths])
    lows, highs = np.moveaxis(np.array(ends), 1, 0)
    return np.stack([lows.min(0), highs.max(0)], -1)
