"""Parts of a log in which an actuator stayed as it was."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from afm_rl.diagnosis.checks import travel
from afm_rl.diagnosis.fit import fit_response
from afm_rl.diagnosis.intervals import independence
from afm_rl.diagnosis.lines import ridge, with_one
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.model import DOWN, FLOOR, Model, Problem, costs, lost, scale_of, weight_of
from afm_rl.diagnosis.response import lagging, look_back
from afm_rl.diagnosis.search import Lead, find_leads
from afm_rl.diagnosis.settings import Settings


@dataclass(frozen=True)
class Part:
    """Rows of a log, and what explains one response in all of them."""

    rows: np.ndarray
    """Numbers of the rows, ascending; what changed may come back after a while."""
    lead: Lead
    model: Model
    weight: float

    def __len__(self) -> int:
        return len(self.rows)


Parts = dict[int, Sequence[Part]]
"""What explains each actuator's response, by its number."""


@dataclass(frozen=True)
class Channel:
    """One actuator of a scaled log, and the thresholds by which it is judged."""

    log: Log
    j: int
    settings: Settings

    @property
    def response(self) -> np.ndarray:
        """Its response, ``(N,)``."""
        return self.log.response[:, self.j]

    def thinned(self) -> Channel:
        """Return it in as many rows as its numbers are found by, at most."""
        return replace(self, log=self.log.thinned(self.settings.refined))

    def predict(self, part: Part) -> np.ndarray:
        """Return the response to all commands by what explains a part, ``(N,)``."""
        return part.model.predict(self.problem(part.lead, part.rows))

    def problem(self, lead: Lead, rows: np.ndarray | None = None) -> Problem:
        """Return the problem of its response; a drift is one along some rows, or all.

        Rows at the begin of an episode, whose commands are not all known, do not count where they
        are few; otherwise the response begins where the first row shows it. Rows before any command
        moves, and long after the last move, do not count: who commands there is not known.
        """
        log = self.log
        settings = self.settings
        clock = lead.clock_of(self.log)
        warm = abs(lead.shape.delay) + 1 + min(3 * lead.shape.lag, 0.05 * len(log))
        since = np.arange(len(log)) - clock.start
        use = since >= warm
        if use.mean() < 0.95:
            use = since > 0
        moves = np.flatnonzero((np.diff(log.command, axis=0) != 0).any(1))
        if len(moves) and settings.travel:
            use[: moves[0]] = use[moves[-1] + 1 + settings.longest_in(log.step) :] = False
        begin = lead.begin_of(log, self.response)
        ends = clock.row if rows is None or log.row is not None else rows
        first, last = (ends[0], ends[-1] + 1) if len(ends) else (0, 1)
        time = (clock.row - first) / (last - first) - 0.5
        at_rest = FLOOR if log.computed else 0.0  # tells only what the commands leave open
        return Problem(clock, log.command, self.response, use, time, begin, at_rest, settings)

    def problem_in(self, rows: np.ndarray, lead: Lead, most: int) -> Problem:
        """Return the problem of its response in some rows, thinned to at most so many.

        Rows before them do not count, but tell the commands that arrive late.
        """
        log, longest = self.log, self.settings.longest
        inside = np.isin(np.arange(len(log)), rows)
        ahead = np.convolve(inside, np.ones(longest))[longest - 1 :] > 0
        near = log.part(np.flatnonzero(ahead)).thinned(most)
        problem = replace(self, log=near).problem(lead)
        own = np.isin(problem.clock.row, rows if log.row is None else log.row[rows])
        return replace(problem, use=problem.use & own)


def fit_part(channel: Channel, rows: np.ndarray, lead: Lead | None = None) -> Part:
    """Fit one response to some rows of a log."""
    j, settings = channel.j, channel.settings
    if lead is None:
        (lead,) = find_leads(channel.log.part(rows), [j], settings)
    most = (settings.fitted, settings.refined)
    small, large = (channel.problem_in(rows, lead, n) for n in most)
    model = fit_response(small, large, lead.driver, lead.starts).led_by(j)
    return Part(rows, lead, model, weight_of(large, model))


def find_parts(channel: Channel, lead: Lead) -> list[Part]:
    """Return the parts of a scaled log in which one response has one explanation each.

    The log is split in two where two explanations are clearly better than one all over it, where
    they differ by more than a tenth of the response, and where the command moves on both sides;
    then each part in the same way. In the end each row goes to the explanation that is best for
    it, and what another explains as well is no part.
    """
    whole = fit_part(channel, np.arange(len(channel.response)), lead)
    parts = _divide(channel, whole, channel.settings.parts)
    parts = _settled(channel, parts) if len(parts) > 1 else parts
    return _with_flipped_end(channel, parts)


def changes_of(parts: Sequence[Part]) -> list[tuple[int, int]]:
    """Return the rows from which on another part holds, row 0 first, and the part's place.

    >>> parts = [Part(np.array(rows), *3 * (None,)) for rows in ([0, 1, 4, 5], [2, 3])]
    >>> changes_of(parts)
    [(0, 0), (2, 1), (4, 0)]
    """
    which = np.empty(sum(map(len, parts)), dtype=int)
    for place, part in enumerate(parts):
        which[part.rows] = place
    rows = np.flatnonzero(np.diff(which, prepend=-1))
    return [(int(row), int(which[row])) for row in rows]


def _divide(channel: Channel, whole: Part, most: int) -> list[Part]:
    """Return the parts of a part."""
    if most < 2 or len(whole) < 2 * channel.settings.shortest:
        return [whole]
    for rows in _likely_halves(channel, whole):
        halves = [fit_part(channel, half) for half in rows]
        settled = _settled(channel, [whole, *halves], 2)
        better = len(settled) == 2
        halves = settled if better else halves
        apart = better and _apart(channel, whole, halves)
        if not apart and whole.model.cost < 0.1:  # what leaves more may mix several
            continue
        first = _divide(channel, halves[0], most - 1)
        parts = first + _divide(channel, halves[1], most - len(first))
        if apart or len(parts) > 2:  # what changes twice may show in the parts of a part only
            return parts
    return [whole]


def _likely_halves(channel: Channel, whole: Part) -> Iterator[list[np.ndarray]]:
    """Yield in which two sets of rows of a part there may be another explanation each."""
    rows = whole.rows
    log = channel.log
    settings = channel.settings
    if log.computed:  # a healthy response is the command
        misses = np.abs(channel.response - log.command[:, channel.j])[rows]
        missed = misses > settings.matters
        inside = np.logical_or.accumulate(missed) & np.logical_or.accumulate(missed[::-1])[::-1]
        if settings.shortest <= inside.sum() <= len(rows) - settings.shortest:
            left = np.abs(channel.response - channel.predict(whole))[rows]
            healthy, outside = misses[~inside].mean(), left[~inside].mean()
            small = 0.1 * settings.matters
            alike = outside < 2 * healthy + small and left[inside].mean() < 2 * outside + small
            if not alike:  # else one explanation is enough
                yield [rows[~inside], rows[inside]]
    place = _likely_change(channel, whole)
    if place is not None:
        yield np.split(rows, [place])


def _with_flipped_end(channel: Channel, parts: list[Part], fewest: int = 6) -> list[Part]:
    """Return the parts, the last rows as one of their own if they have the other sign.

    So few rows tell no more than that: beside the sign the numbers are those before. They have to
    be explained far better than without the flip, and than by a response that rests.
    """
    last = max(parts, key=lambda part: part.rows[-1])
    y, count = channel.response, min(2 * channel.settings.shortest, len(last) // 4)
    rows = last.rows[len(last) - count :]
    if count < fewest or rows[-1] - rows[0] != count - 1:
        return parts
    misses = np.abs(y - channel.predict(last))
    if np.mean(misses[rows] ** 2) < 3 * np.mean(misses[last.rows[:-count]] ** 2):
        return parts
    before = fit_part(channel, last.rows[:-count])
    model = before.model
    gains = tuple(
        g * (-1 if i == DOWN else 1) for i, g in zip(model.others, model.gains, strict=True)
    )
    after = replace(before, model=replace(model, gain=-model.gain, gains=gains))
    scale = math.sqrt(max(model.cost, FLOOR))
    stays, flips = (
        np.log1p(((y - channel.predict(part))[rows] / scale) ** 2) for part in (before, after)
    )
    won = np.cumsum((stays - flips)[::-1])
    size = int(won.argmax()) + 1
    tail = rows[count - size :]
    rests = np.log1p(((y[tail] - np.median(y[tail])) / scale) ** 2)
    gained = min(won[size - 1], (rests - flips[count - size :]).sum())
    if size < fewest or gained < 4 * channel.settings.price(len(y)):
        return parts
    others = [part for part in parts if part is not last]
    return [
        *others,
        replace(before, rows=last.rows[: len(last) - size]),
        replace(after, rows=tail),
    ]


def _settled(channel: Channel, parts: Sequence[Part], most: int = 9, rounds: int = 3) -> list[Part]:
    """Return the parts, each with the rows that it explains best.

    A change has its price, and so has a part: those that are not needed go, and of more than
    ``most`` those that are needed least.
    """
    rows = np.unique(np.concatenate([part.rows for part in parts]))
    log = channel.log
    price = channel.settings.price(len(rows)) * (1 if log.computed else 4)
    for _ in range(rounds):
        residuals = np.stack([channel.response - channel.predict(part) for part in parts])
        misses = np.abs(residuals[:, rows])
        scale = max(float(np.median(misses, 1).min()) / 0.6745, math.sqrt(FLOOR))
        costs = np.log1p((misses / scale) ** 2).clip(max=price)  # no row alone is a part
        costs[:, log.begins[rows]] = 0.0  # where a response begins is no prediction
        kept = list(range(len(parts)))
        cost, which = _cheapest(costs, price)
        while len(kept) > 1:
            fewer = [[k for k in kept if k != gone] for gone in kept]
            options = [(*_cheapest(costs[option], price), option) for option in fewer]
            best = min(options, key=lambda option: option[0])
            if len(kept) <= most and best[0] > cost + price:
                break
            cost, which, kept = best
        chosen = [(parts[k], rows[which == place]) for place, k in enumerate(kept)]
        parts = [
            part if np.array_equal(part.rows, own) else fit_part(channel, own)
            for part, own in chosen
        ]
    return sorted(parts, key=lambda part: part.rows[0])


def _cheapest(costs: np.ndarray, price: float, near: float = 0.05) -> tuple[float, np.ndarray]:
    """Return the least sum of costs ``(K, N)``, one a row, and whose they are (Viterbi 1967).

    A change costs ``price``. Where it may be in several rows, to within ``near``, it is in the
    last: nothing showed it before.

    >>> _cheapest(np.array([[0.0, 9.0, 0.0, 0.0, 9.0, 9.0], [9.0, 0.0, 9.0, 0.0, 0.0, 0.0]]), 5.0)
    (14.0, array([0, 0, 0, 0, 1, 1]))
    """
    total, stay = costs[:, 0], np.arange(len(costs))
    before = []
    for row in costs[:, 1:].T:
        best = int(total.argmin())
        changes = total > total[best] + price - near
        before.append(np.where(changes, best, stay))
        total = np.minimum(total, total[best] + price) + row
    which = [int(total.argmin())]
    for places in reversed(before):
        which.append(int(places[which[-1]]))
    return float(total.min()), np.array(which[::-1])


def _likely_change(channel: Channel, part: Part) -> int | None:
    """Return the place in a part at which two lines are best instead of one, if that matters."""
    rows = part.rows
    model = part.model
    settings = channel.settings
    problem = channel.problem(part.lead, rows)
    shape, u, own = model.shape, problem.u, model.driver
    slow = lagging(problem.clock, u, shape.keep)
    linear = shape.linear
    late = [look_back(problem.clock, slow, linear)[rows], u[rows, own, None]]
    for steps in (1, 3, 8) if len(part) > 400 else ():
        later = linear._replace(delay=linear.delay + steps)
        late.append(look_back(problem.clock, slow[:, own], later)[rows, None])
    late.append(model.parts(problem)[0][rows, None])
    if len(part) < 200 + 40 * u.shape[1]:
        late = late[1:]  # without other commands
    y = problem.y[rows]
    table = np.column_stack([with_one(*late), y])
    size = table.shape[1]
    length = max(len(part) // 60, 5)
    places = np.arange(1, len(part) // length) * length
    sums = np.stack([block.T @ block for block in np.split(table, places)])
    least = max(settings.shortest, 2 * size)
    good = (places >= least) & (len(part) - places >= least)
    if not good.any():
        return None
    before, places, total = np.cumsum(sums, 0)[:-1][good], places[good], sums.sum(0)
    one = _left_over(total[None])[1]
    (left, early), (right, after) = (_left_over(moments) for moments in (before, total - before))
    best = int(np.argmin(left + right))
    whole, *halves = (y - table[:, :-1] @ line for line in (one[0], early[best], after[best]))
    place = int(places[best])
    split = np.concatenate([halves[0][:place], halves[1][place:]])
    won = lost(len(y), *(costs(missed, scale_of(split)).mean() for missed in (whole, split)))
    sides = split[:place], split[place:]
    alone = independence(min(sides, key=np.std))  # the other one may change again
    return place if won * alone > settings.price(len(y) * alone) + size else None


def _left_over(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared residual of lines, and the lines, from moments ``(B, P, P)``."""
    gram, cross = moments[:, :-1, :-1], moments[:, :-1, -1:]
    solution = ridge(gram, cross, 1e-9)
    residual = moments[:, -1, -1] - (solution * cross).sum((1, 2))
    return np.maximum(residual, 0.0), solution[..., 0]


def _apart(channel: Channel, whole: Part, halves: Sequence[Part]) -> bool:
    """Return whether two explanations leave little, and differ enough to matter."""
    rows = whole.rows
    settings = channel.settings
    y = channel.response[rows]
    use = channel.problem(whole.lead).use[rows]
    first, second = (channel.predict(half)[rows] for half in halves)
    early = np.isin(rows, halves[0].rows)
    sides = [side & use for side in (early, ~early) if (side & use).any()]
    split = np.where(early, first, second)
    moved = min(travel(channel.log, whole.model.driver, half.rows) for half in halves)
    explained = all((y - split)[side].var() < 0.1 * y[side].var() for side in sides)
    far = (first - second) ** 2  # of a loop that diverges, one side is far smaller
    apart = min(float(np.sqrt(far[side].mean() / max(y[side].var(), 1e-300))) for side in sides)
    return apart > 2 * settings.matters and (explained or moved >= 0.5 * settings.travel)
