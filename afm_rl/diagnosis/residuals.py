"""What a fit leaves: what it depends on, and rows in which an actuator does not follow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from afm_rl.diagnosis.changes import Channel, Part
from afm_rl.diagnosis.lines import best_line, left_by, missed, with_one
from afm_rl.diagnosis.log import FEWEST, Log
from afm_rl.diagnosis.model import Model, Problem, cut
from afm_rl.diagnosis.response import look_back, respond
from afm_rl.diagnosis.search import Lead, find_leads
from afm_rl.diagnosis.settings import Settings

SIZE, SPEED, EARLIER = "the size of its command", "how fast its command changes", "earlier commands"
OWN = (SIZE, SPEED, EARLIER)
LIKE = {SIZE: ", as if its gain varied", SPEED: ", as if its delay varied"}  # scatter with these


def find_pattern(
    problem: Problem, model: Model, most: int = 3000, least: float = 0.2, scatter: float = 0.15
) -> tuple[str, float]:
    """Return in words what the residual depends on, and which share of its variance that predicts.

    Functions of the own command, its speed, its past, other commands and the time are fitted to one
    half of the rows, and tried on the other one. If none predicts the residual, but one its
    absolute value, the name is that of the scatter, and the share 0.

    Returns:
        ``("", 0.0)`` if the residual looks like noise.
    """
    rows = np.flatnonzero(problem.use)
    rows = rows[:: max(len(rows) // most, 1)]
    residual = cut((problem.y - model.predict(problem))[rows])
    residual -= residual.mean()
    if not residual.any() or len(residual) < FEWEST:
        return "", 0.0
    size = np.abs(residual) - np.abs(residual).mean()
    shares, scatters = {}, {}
    for name, (first, *others) in _features(problem, model).items():
        columns = np.column_stack([first, *others])[rows]
        shares[name] = predictable(columns, residual)
        grows = name not in LIKE or size @ np.abs(first[rows]) > 0
        scatters[name] = predictable(columns, size) if grows else 0.0
    best, widest = max(shares, key=shares.__getitem__), max(scatters, key=scatters.__getitem__)
    if shares[best] > least:
        return f"it depends on {best}", shares[best]
    if scatters[widest] > scatter:
        return f"its scatter depends on {widest}{LIKE.get(widest, '')}", 0.0
    return "", 0.0


def _features(problem: Problem, model: Model) -> dict[str, list[np.ndarray]]:
    """Return groups of functions, each ``(N,)`` or ``(N, F)``."""
    u, clock, linear = problem.u, problem.clock, model.shape.linear._replace(hold=1, phase=0)
    own, followed = u[:, model.driver], model.parts(problem)[0]
    around = (-4, -3, -2, -1, 1, 2, 3, 4, 6, 8, 12)  # steps before the command that is followed
    late = [look_back(clock, own, linear._replace(delay=linear.delay + k)) for k in around]
    speed, slow = late[3] - late[4], late[1] - late[6]  # over 2 and 6 steps
    time = hats(np.arange(len(own)))
    others = np.delete(look_back(clock, u, linear), model.driver, axis=1)
    others = others[:, others.std(0) > 0]
    with_others = [others, np.abs(others), others * followed[:, None]]
    groups = {
        SIZE: [followed, hats(followed)],
        SPEED: [speed, slow, hats(speed), hats(slow)],
        EARLIER: late,
        "the time": [time, time * followed[:, None]],
    }
    return groups | ({"other commands": with_others} if others.shape[1] else {})


def hats(x: np.ndarray, count: int = 8) -> np.ndarray:
    """Return piecewise linear functions of x between its quantiles, ``(N, K)``."""
    knots = np.unique(np.quantile(x, np.linspace(0.01, 0.99, count)))
    return np.column_stack([np.interp(x, knots, unit) for unit in np.eye(len(knots))])


def predictable(columns: np.ndarray, y: np.ndarray) -> float:
    """Return the share of the variance that lines in one half of the rows predict in the other."""
    return 1.0 - missed(with_one(columns), y, 1e-4) / max(float((y**2).sum()), 1e-300)


def without_steps(log: Log, j: int, lead: Lead, settings: Settings) -> tuple[Log, np.ndarray]:
    """Return the log with one response as if its offset were that of the first episode in all.

    And by how much it was another one, ``(E,)``; nothing, if one line explains all episodes as
    well, or if the offset changed once only, and stayed.
    """
    episode, none = log.place, np.empty(0)
    sizes = np.bincount(episode)
    if len(sizes) < 3 or sizes.min() < settings.shortest:
        return log, none
    clock = lead.clock_of(log)
    y = log.response[:, j]
    own = np.eye(len(sizes))[episode]
    moves = [respond(clock, log.command[:, lead.driver], shape) for shape in lead.starts]
    designs = [np.column_stack([x, own]) for x in moves]
    each = [left_by(design, y).var() for design in designs]
    best = int(np.argmin(each))
    gain, *offsets = best_line(designs[best], y)
    apart = np.abs(np.diff(offsets)) > 4 * settings.matters * abs(gain)
    if each[best] > 0.2 * left_by(with_one(moves[best]), y).var() or apart.sum() < 2:
        return log, none
    shift = np.array(offsets) - offsets[0]
    return log.with_column("response", j, y - shift[episode]), shift


def with_sign_of_other(
    log: Log, j: int, lead: Lead, settings: Settings, delays: int = 12
) -> tuple[Log, int | None]:
    """Return the log with a command that has the sign of another one, and which that is.

    Steering may be reversed where throttle is negative. Both signs must occur, hardly anything of
    the response may be left then, and both halves of the log must show it: else the actuator
    changed once. Nothing is changed otherwise.
    """
    u, y = log.command[:, j], log.response[:, j]
    signs = np.where(log.command < 0, -1.0, 1.0)
    candidates = [i for i, down in enumerate((signs < 0).mean(0)) if i != j and 0.1 < down < 0.9]
    if lead.left < 0.2 or not candidates or not u.any():
        return log, None
    products = u[:, None] * signs[:, candidates]
    late = range(min(delays, len(u) // 4))
    shares = np.array([_explained(products[: len(u) - k], y[k:]) for k in late])
    k, best = np.unravel_index(shares.argmax(), shares.shape)
    halves = zip(
        np.array_split(np.column_stack([u, products[:, best]])[: len(u) - k], 2),
        np.array_split(y[k:], 2),
        strict=True,
    )
    repeats = min(np.diff(_explained(*half)) for half in halves) > 0.1
    other = log.with_column("command", j, products[:, best])
    (signed,) = find_leads(other, [j], settings)
    return (other, candidates[best]) if repeats and signed.left < 0.1 else (log, None)


def _explained(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the shares ``(M,)`` of a response ``(N,)`` that columns ``(N, M)`` explain."""
    x, y = x - x.mean(0), y - y.mean()
    power = np.maximum((x**2).sum(0), 1e-300) * max(float(y @ y), 1e-300)
    return (y @ x) ** 2 / power


def without_lost(
    channel: Channel, lead: Lead, parts: Sequence[Part], repeats: bool, apart: float = 5.0
) -> tuple[Log, float]:
    """Return the log with one response as it would be if it always followed, and the share lost.

    A line is fitted to the rows that it fits best (least trimmed squares), behind the delay, lag
    and rate limit that leave least. The other rows are lost if they are all over the log, if
    neither the command nor its last moves predict which they are, and if no explanation of all
    rows comes near.
    """
    log = channel.log
    y = channel.response
    clock = lead.clock_of(channel.log)
    best = y - y.mean()
    for part in parts:
        best[part.rows] = (y - channel.predict(part))[part.rows]
    if lead.left < 0.004 or best.std() < 0.05 * y.std():  # nothing to look for
        return log, 0.0
    u = log.command[:, lead.driver]
    begin = lead.begin_of(log, y)
    known = np.ones(len(y), dtype=bool)
    if repeats:
        known &= np.diff(y, prepend=np.inf) != 0
    options = []
    for shape in lead.starts:
        place = clock.places(shape.delay).astype(int)
        # Where the time between two rows is longer, commands between them are not known.
        near = clock.time[np.minimum(place + 1, len(y) - 1)] - clock.time[place] < 1.5
        x = respond(clock, u, shape, begin)
        options.append(_trimmed(with_one(x), y, known & near, apart))
    line, chosen = min(options, key=lambda option: np.abs(y - option[0])[option[1]].mean())
    far = np.abs(y - line)
    residual = (y - line)[chosen]
    lost = far > max(apart * _scale(residual), 0.02 * y.std())  # less is no matter
    share = float(lost.mean())
    blocks = np.array([block.mean() for block in np.array_split(lost, 8)])
    if not 0.006 < share < 0.45 or (blocks > 0.2 * share).sum() < 5:
        return log, 0.0
    late = clock.places(max(shape.delay for shape in lead.starts)).astype(int)
    moves = [hats(np.abs(u - u[np.maximum(late - k, clock.start)])) for k in (2, 8, 20)]
    since = hats(np.minimum(np.arange(len(y)) - clock.start, 100.0))  # what was before is not known
    if predictable(np.column_stack([hats(u[late]), since, *moves]), lost - share) > 0.25:
        return log, 0.0
    if np.median(far[lost]) < 2 * far[lost].min():  # the tail of a noise, which ends nowhere
        return log, 0.0
    explained = (best[lost] ** 2).mean() < 0.3 * (far[lost] ** 2).mean()
    if explained or residual.std() > 0.35 * best.std():
        return log, 0.0
    drawn = np.random.default_rng(0).choice(residual, int(lost.sum()))
    followed = y.copy()
    followed[lost] = line[lost] + drawn
    return log.with_column("response", channel.j, followed), share


def _trimmed(
    design: np.ndarray, y: np.ndarray, known: np.ndarray, apart: float, share: float = 0.55
) -> tuple[np.ndarray, np.ndarray]:
    """Return the line through the share of rows that it fits best, and which rows are near it."""
    chosen = known
    for _ in range(15):
        line = design @ best_line(design[chosen], y[chosen])
        far = np.abs(y - line)
        chosen = known & (far <= np.quantile(far[known], share))
    for _ in range(2):
        chosen = known & (far <= apart * _scale(far[chosen]))
        line = design @ best_line(design[chosen], y[chosen])
        far = np.abs(y - line)
    return line, chosen


def _scale(residual: np.ndarray) -> float:
    """Return the standard deviation of residuals, whatever half of them is."""
    return float(np.median(np.abs(residual))) / 0.6745
