"""What a log cannot tell: commands that do not move, responses that nobody measured or caused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from afm_rl.diagnosis.findings import Status
from afm_rl.diagnosis.lines import left_by, missed, with_one
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.response import Shape, follow_with_stiction, respond
from afm_rl.diagnosis.scale import ends_of
from afm_rl.diagnosis.search import Lead, find_leads
from afm_rl.diagnosis.settings import Settings

Doubt = tuple[Status, str]
MIXED: Doubt = (
    "cannot tell",
    "its command alternates between two series, as of two publishers; log each on its own",
)
SUMMED: Doubt = (
    "cannot tell",
    "its response moves as if it added up its command; log its rate of change",
)


def find_doubts(
    log: Log, leads: Sequence[Lead], reach: np.ndarray, exact: Sequence[bool], settings: Settings
) -> dict[int, Doubt]:
    """Return why nothing can be said of some actuators, by number."""
    idle = bool(log.effort) and all(np.ptp(values) == 0 for values in log.effort.values())
    summed = _summed(log, leads)
    ranges = reach * (np.ptp(log.command, axis=0) > 0)
    usual = float(np.median(ranges[ranges > 0])) if len(ranges) > 2 and ranges.any() else 0.0

    def doubt(j: int) -> Doubt | None:
        measured, left = not log.computed, leads[j].left
        if log.names[j] in log.doubts:
            return "cannot tell", log.doubts[log.names[j]]
        if not ranges[j]:
            return "cannot tell", "its command does not change; move it"
        if measured and not np.ptp(log.response[:, j]):
            return "cannot tell", "its response never changes; is it logged, and powered?"
        if idle:
            name, values = next(iter(log.effort.items()))
            return "not actuated", f"{name} is {values[0]:.4g} all the time; is it armed?"
        if measured and exact[j]:
            text = "its response is its command, digit by digit; log what a sensor reads"
            return "not measured", text
        if measured and left > 0.1 and alternates(log.command[:, j]):
            return MIXED
        if measured and left > 0.1 and (answer := _answer(log, j, left, settings)):
            return answer
        if ranges[j] < settings.moves * usual:
            share = 100 * ranges[j] / usual
            return "cannot tell", f"its command moves by {share:.1g} % of the usual; move it"
        return SUMMED if j in summed else None

    doubts = ((j, doubt(j)) for j in range(len(leads)))
    return {j: said for j, said in doubts if said}


def alternates(command: np.ndarray) -> bool:
    """Return whether a command jumps back and forth between two series that differ.

    Every other value is nearer than the next one; and the two series do not move alike, as those of
    a command that chatters would.

    >>> slow = np.sin(np.arange(50) / 8)
    >>> two = np.column_stack([slow, np.cos(np.arange(50) / 5)]).ravel()
    >>> alternates(two), alternates(slow), alternates(np.column_stack([slow, slow + 1]).ravel())
    (True, False, False)
    """
    values = command[np.flatnonzero(np.diff(command, prepend=np.inf))]
    if len(values) < 40:
        return False
    near, far = (np.median(np.abs(values[k:] - values[:-k])) for k in (2, 1))
    one, other = (values[k : len(values) // 2 * 2 : 2] for k in (0, 1))
    if min(np.ptp(one), np.ptp(other)) == 0.0 and len(values) < len(command) / 3:
        return False  # pulses from a level of rest, each held
    one, other = one - one.mean(), other - other.mean()
    power = max(float(np.sqrt((one @ one) * (other @ other))), 1e-300)
    return bool(near < 0.7 * far and abs(one @ other) < 0.9 * power)


def effort_notes(log: Log, often: float = 0.2) -> tuple[str, ...]:
    """Return which motors were driven as hard as can be in more than a fifth of the rows.

    >>> pwm = {"pwm_1": np.minimum(np.arange(100.0), 60.0)}
    >>> effort_notes(Log(("a",), np.zeros((100, 1)), np.zeros((100, 1)), effort=pwm))
    ('pwm_1 is at its limit, 60, in 40 % of the rows: no more can be commanded',)
    """
    return tuple(
        f"{name} is at its limit, {values.max():.5g}, in {100 * share:.0f} % of the rows: no more "
        "can be commanded"
        for name, values in log.effort.items()
        if (share := float((values == values.max()).mean())) > often and len(set(values)) > 9
    )


def echoes(log: Log, rows: Sequence[int] = (0, 1)) -> list[bool]:
    """Return which responses are exactly their commands, of the same row or of the one before."""
    apart = log.place
    exact = np.zeros(len(log.names), dtype=bool)
    for late in rows:
        u, y = log.command[: len(apart) - late], log.response[late:]
        same = apart[late:] == apart[: len(apart) - late]
        exact |= (u == y)[same].all(0)
    return list(exact & (np.ptp(log.command, axis=0) > 0))


def travel(log: Log, j: int, rows: slice | np.ndarray = slice(None), least: float = 0.1) -> float:
    """Return how far a command moves in some rows, in its ranges.

    Moves below a share of its range, ``least``, do not count.

    >>> u = np.sin(np.arange(100.0) / 10)[:, None]
    >>> round(travel(Log(("a",), u, u), 0))
    3
    """
    low, high = ends_of(log.command[:, j])
    size, u = max(float(high - low), 1e-300), log.command[rows, j]
    places = follow_with_stiction(u, least * size, np.zeros(len(u), dtype=int))
    return float(np.abs(np.diff(places)).clip(max=size).sum() / size)


def copies_of(command: np.ndarray) -> list[list[int]]:
    """Return for each command the others that are the same up to a factor, by their correlation."""
    u = command - command.mean(0)
    power = np.sqrt((u**2).sum(0))
    alike = np.abs(u.T @ u) / np.maximum(np.outer(power, power), 1e-300)
    np.fill_diagonal(alike, 0.0)
    return [np.flatnonzero(row > 0.999).tolist() for row in alike]


def _answer(log: Log, j: int, left: float, settings: Settings) -> Doubt | None:
    """Return what a command that answers its response leaves to say, if it does.

    Not where it explained the response in half of the log: then something changed.

    A loop that hovers looks like one that is not armed. But its command has moves of its own, from
    sensors that are not logged: in a quarter of a tenth of its spread and more.
    """
    u, y = log.command[:, j], log.response[:, j]
    if not _causes(log, y, u):
        return None
    half = log.part(slice(len(u) // 2))
    if find_leads(half, [j], settings)[0].left < 0.1:
        return None
    acts = _causes(log, u, y)
    rows, own, other = _pasts(log, u, y)
    if not acts and left_by(with_one(own, other, y[rows]), u[rows]).std() < 0.025 * u.std():
        text = "its command answers its response, and not the other way round; is it armed?"
        return "not actuated", text
    if not acts or left > 0.3:
        return "cannot tell", "its command answers its response, as of a loop that holds; excite it"
    return None


def _pasts(
    log: Log, one: np.ndarray, other: np.ndarray, every: int = 1, past: int = 8
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows that have a past, and both series in it, ``(M, past)`` each."""
    rows = np.flatnonzero(np.arange(len(one)) - log.start >= past * every)
    late = rows[:, None] - np.arange(1, past + 1) * every
    return rows, one[late], other[late]


def _causes(log: Log, cause: np.ndarray, effect: np.ndarray, past: int = 8) -> bool:
    """Return whether the past of one series predicts another beyond its own past (Granger 1969).

    A tenth of what the own past leaves must be predicted in rows that were held out, with the past
    8 rows or each fifth of the past 40.
    """
    if not (np.ptp(cause) > 0 and np.ptp(effect) > 0):
        return False
    cause, effect = ((x - x.mean()) / x.std() for x in (cause, effect))
    shares = []
    for every in (1, 5):
        rows, own, other = _pasts(log, effect, cause, every, past)
        if len(rows) < 20 * past:
            continue
        designs = with_one(own), with_one(own, other)
        before, after = (missed(design, effect[rows], 1e-9) for design in designs)
        shares.append(1 - after / max(before, 1e-300))
    return max(shares, default=0.0) > 0.1


def _summed(log: Log, leads: Sequence[Lead]) -> set[int]:
    """Return the actuators whose responses are sums of their commands, and no positions.

    The sum has to explain far more than any position that is on its way: a servo whose rate is
    limited settles where a command holds long enough, or turns back towards the next one.
    """
    odd = [j for j, lead in enumerate(leads) if lead.left > 0.1 and lead.driver == j]
    episode = log.place
    begins = np.eye(episode[-1] + 1)[episode] if episode[-1] < 50 else np.ones((len(episode), 1))
    summed = set()
    for j in odd:
        u, y, lead = log.command[:, j], log.response[:, j], leads[j]
        clock = lead.clock_of(log)
        half = max(0.5 * float(np.ptp(u)), 1e-12)
        begin = lead._replace(line=lead.line or (1.0, 0.0)).begin_of(log, y)
        servos = (Shape(rate=half * rate) for rate in (0.2, 0.1, 0.05, 0.02, 0.01))
        places = (respond(clock, u, shape, begin) for shape in (*lead.starts, *servos))
        left = [_left(begins, place, y) for place in places]
        sums = np.column_stack([np.cumsum(u - u.mean()), np.arange(len(u))])
        if _left(begins, sums, y) < min(0.1, 0.3 * min(lead.left, *left)):
            summed.add(j)
    return summed


def _left(begins: np.ndarray, columns: np.ndarray, y: np.ndarray) -> float:
    """Return the share of the variance of a response that lines leave."""
    residual = left_by(np.column_stack([begins, columns]), y)
    return float(residual.var() / max(y.var(), 1e-300))
