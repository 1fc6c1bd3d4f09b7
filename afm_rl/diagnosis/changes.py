"""Parts of a log in which an actuator stayed as it was."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from afm_rl.diagnosis.checks import travel
from afm_rl.diagnosis.fit import FLOOR, consistent, fit_response
from afm_rl.diagnosis.intervals import independence
from afm_rl.diagnosis.lines import ridge
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.model import Model, Problem, costs, scale_of, weight_of
from afm_rl.diagnosis.response import lagging, look_back
from afm_rl.diagnosis.search import Lead, beginning, find_leads
from afm_rl.diagnosis.settings import Settings


@dataclass(frozen=True)
class Part:
    """A part of a log, and what explains one response in it."""

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


def problem_of(log: Log, j: int, part: Part | Lead, settings: Settings | None = None) -> Problem:
    """Return the problem of one response.

    Rows at the begin of an episode, whose commands are not all known, do not count where they are
    few; otherwise the response begins where the first row shows it. Rows before any command moves,
    and long after the last move, do not count: who commands there is not known.
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
    moves = np.flatnonzero((np.diff(log.command, axis=0) != 0).any(1))
    settings = settings or Settings()
    settle = max(settings.longest_s / log.step if log.t is not None else 0, settings.longest)
    if len(moves) and settings.travel:
        use[: moves[0]] = use[moves[-1] + 1 + int(settle) :] = False
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
    most = (settings.fitted, settings.refined)
    small, large = (problem_of(rows.thinned(n), j, lead, settings) for n in most)
    model = fit_response(small, large, lead.driver, lead.starts, settings).led_by(j)
    return Part(first, last, lead, model, weight_of(large, model))


def find_parts(log: Log, j: int, lead: Lead, settings: Settings) -> list[Part]:
    """Return the parts of a scaled log in which one response has one explanation each.

    The log is split in two where two explanations are clearly better than one all over it, where
    they differ by more than a tenth of the response, and where the command moves on both sides;
    then each part in the same way.
    """
    parts = _divide(
        log, j, fit_part(log, j, 0, len(log.command), settings, lead), settings.parts, settings
    )
    for k in range(len(parts) - 1 if len(parts) > 2 else 0):  # borders, now that no part is mixed
        left, right = parts[k : k + 2]
        row = _exact_row(log, j, left, right, settings, 0.5)
        if abs(row - left.last) > 1:
            parts[k] = fit_part(log, j, left.first, row, settings)
            parts[k + 1] = fit_part(log, j, row, right.last, settings)
    return parts


def _divide(log: Log, j: int, whole: Part, most: int, settings: Settings) -> list[Part]:
    """Return the parts of a part."""
    if most < 2 or len(whole) < 2 * settings.shortest:
        return [whole]
    row = _likely_change(log, j, whole, settings)
    if row is None:
        return [whole]
    for _ in range(2):
        left = fit_part(log, j, whole.first, row, settings)
        right = fit_part(log, j, row, whole.last, settings)
        better = _exact_row(log, j, left, right, settings)
        if abs(better - row) < 0.01 * len(whole):
            break
        row = better
    apart = _apart(log, j, whole, left, right, settings)
    if not apart and whole.model.cost < 0.1:  # what leaves more may mix several
        return [whole]
    first = _divide(log, j, left, most - 1, settings)
    parts = first + _divide(log, j, right, most - len(first), settings)
    # What changes twice may show in the parts of a part only.
    return parts if apart or len(parts) > 2 else [whole]


def _likely_change(log: Log, j: int, part: Part, settings: Settings) -> int | None:
    """Return the row at which two lines are best instead of one, if that is clear and matters."""
    problem, rows, model = problem_of(log, j, part), part.rows, part.model
    shape, u, own = model.shape, log.command, model.driver
    slow = lagging(problem.clock, u, shape.keep) if shape.keep else u
    linear = shape.linear
    late = [look_back(problem.clock, slow, linear)[rows], u[rows, own, None]]
    for steps in (1, 3, 8) if len(part) > 400 else ():
        later = linear._replace(delay=linear.delay + steps)
        late.append(look_back(problem.clock, slow[:, own], later)[rows, None])
    late.append(model.parts(problem)[0][rows, None])
    if len(part) < 200 + 40 * u.shape[1]:
        late = late[1:]  # without other commands
    y = problem.y[rows]
    table = np.column_stack([*late, np.ones(len(y)), y])
    size = table.shape[1]
    length = max(len(part) // 60, 5)
    ends = np.append(np.arange(1, len(part) // length) * length, len(part))
    sums = np.stack([block.T @ block for block in np.split(table, ends[:-1])])
    before, places = np.cumsum(sums, 0)[:-1], ends[:-1]
    least = max(settings.shortest, 2 * size)
    good = (places >= least) & (len(part) - places >= least)
    if not good.any():
        return None
    before, places, total = before[good], places[good], sums.sum(0)
    one = _left_over(total[None])[1]
    (left, early), (right, after) = (_left_over(moments) for moments in (before, total - before))
    best = int(np.argmin(left + right))
    misses = [y - table[:, :-1] @ line for line in (one[0], early[best], after[best])]
    near = np.arange(len(y))
    row = int(places[best])
    inside = np.abs(near - row) <= length
    turns = np.cumsum((misses[1] ** 2 - misses[2] ** 2)[inside])
    row = int(
        np.clip(near[inside][turns.argmin()] + 1, settings.shortest, len(y) - settings.shortest)
    )
    split = np.where(near < row, misses[1], misses[2])
    scale = scale_of(split)
    gain, split_cost = costs(misses[0], scale), costs(split, scale)
    won = len(y) * math.log((gain.mean() + FLOOR) / (split_cost.mean() + FLOOR))
    apart = float(np.std(misses[1] - misses[2]))
    sides = near < row, near >= row
    clear = any(consistent((gain - split_cost)[side], settings) for side in sides)
    clean = min(sides, key=lambda side: split[side].std())  # the other one may change again
    alone = independence(split[clean])
    if (
        won * alone < settings.price(len(y) * alone) + size
        or apart < 2 * settings.matters * y.std()
        or not clear
    ):
        return None
    return part.first + row


def _left_over(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared residual of lines, and the lines, from moments ``(B, P, P)``."""
    gram, cross = moments[:, :-1, :-1], moments[:, :-1, -1:]
    solution = ridge(gram, cross, 1e-9)
    residual = moments[:, -1, -1] - (solution * cross).sum((1, 2))
    return np.maximum(residual, 0.0), solution[..., 0]


def _exact_row(
    log: Log, j: int, left: Part, right: Part, settings: Settings, share: float = 0.05
) -> int:
    """Return the row from which on the right explanation is better."""
    rows = slice(left.first, right.last)
    y = log.response[rows, j]
    misses = [np.abs(y - part.predict(log, j)[rows]) for part in (left, right)]
    cut = 4 * min(np.median(m) for m in misses) / 0.6745 + 1e-9
    early, late = (np.minimum(m, cut) ** 2 for m in misses)
    total = np.concatenate([[0.0], np.cumsum(early - late)])
    # Close by: where one of both is a mixture itself, it may be worse wherever the other holds.
    near = max(settings.shortest // 2, int(share * len(y)))
    low = max(settings.shortest, len(left) - near)
    high = min(len(y) - settings.shortest, len(left) + near) + 1
    return left.first + low + int(total[low:high].argmin())


def _apart(log: Log, j: int, whole: Part, left: Part, right: Part, settings: Settings) -> bool:
    """Return whether two explanations are clearly better than one, and differ enough to matter."""
    rows, border, own = whole.rows, len(left), whole.model.driver
    one, first, second = (part.predict(log, j)[rows] for part in (whole, left, right))
    y, use = log.response[rows, j], problem_of(log, j, whole, settings).use[rows]
    early = np.arange(len(y)) < border
    sides = [side & use for side in (early, ~early) if (side & use).any()]
    split = np.where(early, first, second)
    scale = scale_of((y - split)[use])
    split_cost, gain = costs(y - split, scale), costs(y - one, scale)
    gain -= split_cost
    weight = min(independence((y - split)[use]), 0.5 + 0.5 * whole.weight)
    numbers = left.model.size + right.model.size + 4 - whole.model.size
    better, best = gain[use].mean() + split_cost[use].mean(), split_cost[use].mean()
    won = len(y) * weight * math.log((better + FLOOR) / (best + FLOOR))
    moved = min(travel(log, own, part.rows) for part in (left, right))
    rest = [((y - split)[side].var(), y[side].var()) for side in sides]
    explained = all(left < 0.1 * moves for left, moves in rest)
    known = all(left < 0.5 * moves or moves < 0.05 * y[use].var() for left, moves in rest)
    apart = min(float(np.sqrt(((first - second)[side] ** 2).mean())) for side in sides)
    return (
        won > settings.price(len(y) * weight) * max(numbers, 2)
        and any(consistent(gain[side], settings) for side in sides)
        and apart > 2 * settings.matters * split[use].std()
        and (explained or known and moved >= 0.5 * settings.travel)
    )
