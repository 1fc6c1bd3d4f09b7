"""Parts of a log in which an actuator stayed as it was."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from afm_rl.diagnosis.fit import FLOOR, consistent, fit_response
from afm_rl.diagnosis.intervals import independence
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.model import Model, Problem, costs, scale_of, weight_of
from afm_rl.diagnosis.response import lagging, look_back
from afm_rl.diagnosis.search import Lead, beginning, find_leads
from afm_rl.diagnosis.settings import Settings

SHORTEST = 40  # rows of a part
PARTS = 5  # at most


@dataclass(frozen=True)
class Part:
    """A part of a log, and what explains one response in it.

    Args:
        first: its first row.
        last: the row after its last one.
        lead: where the search began.
        model: what explains it, in the units of a scaled log.
        weight: how many independent rows a row counts as.
    """

    first: int
    last: int
    lead: Lead
    model: Model
    weight: float

    @property
    def rows(self) -> slice:
        """Return the rows of the log."""
        return slice(self.first, self.last)

    def __len__(self) -> int:
        return self.last - self.first

    def predict(self, log: Log, j: int) -> np.ndarray:
        """Return the response to all commands of a log, ``(N,)``."""
        return self.model.predict(problem_of(log, j, self))


def problem_of(log: Log, j: int, part: Part | Lead) -> Problem:
    """Return the problem of one response.

    Rows at the begin of an episode, whose commands are not all known, do not count where they are
    few; otherwise the response begins where the first row shows it.
    """
    first, last = (part.first, part.last) if isinstance(part, Part) else (0, len(log.command))
    lead = part.lead if isinstance(part, Part) else part
    clock = lead.clock_of(log)
    warm = abs(lead.delay) + 1
    if lead.keep:
        warm += min(3 / -math.log(lead.keep), 0.05 * len(log.command))
    since = np.arange(len(log.command)) - clock.start
    use = since >= warm
    if use.mean() < 0.95:
        use = since > 0
    begin = None
    if lead.line is not None:
        u = log.command[:, lead.driver]
        begin = beginning(clock, u, log.response[:, j], lead.line)
    rows = np.arange(len(use)) if log.row is None else log.row
    if log.row is not None:  # a part, thinned
        first, last = int(rows[0]), int(rows[-1]) + 1
    time = (rows - first) / (last - first) - 0.5
    return Problem(clock, log.command, log.response[:, j], use, time, begin)


def fit_part(
    log: Log, j: int, first: int, last: int, settings: Settings, lead: Lead | None = None
) -> Part:
    """Fit one response to some rows of a log."""
    rows = log.part(slice(first, last))
    if lead is None:
        (lead,) = find_leads(rows.thinned(settings.searched), [j], settings)
    small, large = (
        problem_of(rows.thinned(most), j, lead) for most in (settings.fitted, settings.refined)
    )
    model = fit_response(small, large, lead.driver, lead.starts, settings).led_by(j)
    return Part(first, last, lead, model, weight_of(large, model))


def find_parts(log: Log, j: int, lead: Lead, settings: Settings) -> list[Part]:
    """Return the parts of a scaled log in which one response has one explanation each.

    The log is split in two where two explanations are clearly better than one all over it, where
    they differ by more than a tenth of the response, and where the command moves on both sides;
    then each part in the same way.
    """
    parts = _divide(log, j, fit_part(log, j, 0, len(log.command), settings, lead), PARTS, settings)
    for k in range(len(parts) - 1 if len(parts) > 2 else 0):  # borders, now that no part is mixed
        left, right = parts[k : k + 2]
        row = _exact_row(log, j, left, right, 0.5)
        if abs(row - left.last) > 1:
            parts[k] = fit_part(log, j, left.first, row, settings)
            parts[k + 1] = fit_part(log, j, row, right.last, settings)
    return parts


def _divide(log: Log, j: int, whole: Part, most: int, settings: Settings) -> list[Part]:
    """Return the parts of a part."""
    if most < 2 or len(whole) < 2 * SHORTEST:
        return [whole]
    row = _likely_change(log, j, whole, settings)
    if row is None:
        return [whole]
    for _ in range(3):
        left = fit_part(log, j, whole.first, row, settings)
        right = fit_part(log, j, row, whole.last, settings)
        better = _exact_row(log, j, left, right)
        if abs(better - row) < 2:
            break
        row = better
    apart = _apart(log, j, whole, left, right, settings)
    if not apart and whole.model.cost < 0.03:  # what leaves more may mix several
        return [whole]
    first = _divide(log, j, left, most - 1, settings)
    found = first + _divide(log, j, right, most - len(first), settings)
    # What changes twice may show in the parts of a part only.
    return found if apart or len(found) > 2 else [whole]


def _likely_change(log: Log, j: int, part: Part, settings: Settings) -> int | None:
    """Return the row at which two lines are best instead of one, if that matters at all."""
    problem, rows, model = problem_of(log, j, part), part.rows, part.model
    shape, u, own = model.shape, log.command, model.driver
    slow = lagging(problem.clock, u, shape.keep) if shape.keep else u
    linear = shape.linear
    late = [look_back(problem.clock, slow, linear)[rows]]
    unclear = model.cost > 0.03
    if unclear:  # a delay that is that of no part
        late.append(u[rows, own, None])
    for more in (1, 3, 8) if len(part) > 400 else ():
        later = linear._replace(delay=linear.delay + more)
        late.append(look_back(problem.clock, slow[:, own], later)[rows, None])
    late.append(model.parts(problem)[0][rows, None])
    if len(part) < 200 + 40 * u.shape[1]:
        late = late[1:]  # without other commands
    design = np.column_stack(late)
    y = problem.y[rows]
    table = np.column_stack([design, np.ones(len(y)), y])
    size = table.shape[1]
    length = max(len(part) // 60, 5)
    ends = np.append(np.arange(1, len(part) // length) * length, len(part))
    sums = np.stack([block.T @ block for block in np.split(table, ends[:-1])])
    before, places = np.cumsum(sums, 0)[:-1], ends[:-1]
    least = max(SHORTEST, 2 * size)
    good = (places >= least) & (len(part) - places >= least)
    if not good.any():
        return None
    before, places, total = before[good], places[good], sums.sum(0)
    ((whole,), _), (left, early), (right, later) = (
        _left_over(moments) for moments in (total[None], before, total - before)
    )
    floor = FLOOR * len(y)
    gain = len(part) * np.log((whole + floor) / (left + right + floor))
    best = int(np.argmax(gain))
    turned = early[best] - later[best]
    apart = turned @ total[:-1, :-1] @ turned / len(y)
    enough = (settings.penalty + size) / (1.0 if unclear else part.weight)
    if gain[best] < enough or apart < (2 * settings.matters) ** 2 * y.var():
        return None
    return part.first + int(places[best])


def _left_over(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared residual of lines, and the lines, from moments ``(B, P, P)``."""
    gram, cross = moments[:, :-1, :-1], moments[:, :-1, -1:]
    size = gram.shape[-1]
    ridge = 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(size)
    solution = np.linalg.solve(gram + ridge, cross)
    left = moments[:, -1, -1] - (solution * cross).sum((1, 2))
    return np.maximum(left, 0.0), solution[..., 0]


def _exact_row(log: Log, j: int, left: Part, right: Part, share: float = 0.05) -> int:
    """Return the row from which on the right explanation is better."""
    rows = slice(left.first, right.last)
    y = log.response[rows, j]
    misses = [np.abs(y - part.predict(log, j)[rows]) for part in (left, right)]
    cut = 4 * min(np.median(m) for m in misses) / 0.6745 + 1e-9
    early, late = (np.minimum(m, cut) ** 2 for m in misses)
    total = np.concatenate([[0.0], np.cumsum(early - late)])
    # Close by: where one of both is a mixture itself, it may be worse wherever the other holds.
    near = max(SHORTEST // 2, int(share * len(y)))
    low = max(SHORTEST, len(left) - near)
    high = min(len(y) - SHORTEST, len(left) + near) + 1
    return left.first + low + int(total[low:high].argmin())


def _apart(log: Log, j: int, whole: Part, left: Part, right: Part, settings: Settings) -> bool:
    """Return whether two explanations are clearly better than one, and differ enough to matter."""
    rows, border = whole.rows, len(left)
    own = log.command[rows, whole.model.driver]
    moves = min(own[:border].std(), own[border:].std())
    one, first, second = (part.predict(log, j)[rows] for part in (whole, left, right))
    y, use = log.response[rows, j], problem_of(log, j, whole).use[rows]
    split = np.where(np.arange(len(y)) < border, first, second)
    scale = scale_of((y - split)[use])
    kept = costs((y - split)[use], scale)
    gain = costs((y - one)[use], scale) - kept
    weight = min(independence((y - split)[use]), 0.5 + 0.5 * whole.weight)
    more = left.model.size + right.model.size + 4 - whole.model.size
    won = len(y) * weight * math.log((kept.mean() + gain.mean() + FLOOR) / (kept.mean() + FLOOR))
    side = np.arange(len(y))[use] < border
    clear = [consistent(gain[some], settings) for some in (side, ~side) if some.sum() > SHORTEST]
    apart = min(
        float(np.sqrt(((first - second)[some & use] ** 2).mean()))
        for some in (np.arange(len(y)) < border, np.arange(len(y)) >= border)
        if (some & use).any()
    )
    return (
        won > settings.penalty * max(more, 2)
        and any(clear)
        and apart > 2 * settings.matters * split[use].std()
        and moves > 0.2 * own.std()
    )
