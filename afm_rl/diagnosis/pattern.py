"""What the residual of a fit depends on: noise depends on nothing."""

from __future__ import annotations

import numpy as np

from afm_rl.diagnosis.model import Model, Problem, cut
from afm_rl.diagnosis.response import look_back

SIZE, SPEED, EARLIER = "the size of its command", "how fast its command changes", "earlier commands"
OTHERS, TIME = "other commands", "the time"
OWN = (SIZE, SPEED, EARLIER)
LIKE = {SIZE: ", as if its gain varied", SPEED: ", as if its delay varied"}  # scatter with these


def find_pattern(
    problem: Problem, model: Model, most: int = 3000, least: float = 0.2, scatter: float = 0.15
) -> tuple[str, float]:
    """Return in words what the residual depends on, and which share of its variance that predicts.

    Functions of the own command, its speed, its past, other commands and the time are fitted to one
    half of the rows, and tried on the other one. If none predicts the residual, but one its
    absolute value, the name is that of the scatter, and the share 0.

    Args:
        problem: the log of one actuator.
        model: what was fitted to it.
        most: rows that are looked at, at most.
        least: share of the residual that has to be predicted; otherwise it is noise.
        scatter: the same for its absolute value.

    Returns:
        ``("", 0.0)`` if the residual looks like noise.
    """
    rows = np.flatnonzero(problem.use)
    rows = rows[:: max(len(rows) // most, 1)]
    residual = cut((problem.y - model.predict(problem))[rows])
    residual -= residual.mean()
    if not residual.any():
        return "", 0.0
    size = np.abs(residual) - np.abs(residual).mean()
    shares, scatters = {}, {}
    for name, (first, *more) in _features(problem, model).items():
        columns = np.column_stack([first, *more])[rows]
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
    found = {
        SIZE: [followed, hats(followed)],
        SPEED: [speed, slow, hats(speed), hats(slow)],
        EARLIER: late,
        TIME: [time, time * followed[:, None]],
    }
    return found | ({OTHERS: with_others} if others.shape[1] else {})


def hats(x: np.ndarray, count: int = 8) -> np.ndarray:
    """Return piecewise linear functions of x between its quantiles, ``(N, K)``."""
    knots = np.unique(np.quantile(x, np.linspace(0.01, 0.99, count)))
    return np.column_stack([np.interp(x, knots, unit) for unit in np.eye(len(knots))])


def predictable(columns: np.ndarray, y: np.ndarray, folds: int = 20) -> float:
    """Return the share of the variance that lines in one half of the rows predict in the other.

    Args:
        columns: functions, ``(N, F)``.
        y: what is predicted, of mean 0, ``(N,)``.
        folds: blocks of rows, of which every second one is predicted from the others.
    """
    rows = len(y)
    design = np.column_stack([np.ones(rows), columns])
    held_out = np.arange(rows) * folds // rows % 2 == 0
    missed = 0.0
    for test in (held_out, ~held_out):
        x = design[~test]
        gram = x.T @ x
        gram += 1e-4 * gram.trace() / len(gram) * np.eye(len(gram))
        missed += float(((y - design @ np.linalg.solve(gram, x.T @ y[~test]))[test] ** 2).sum())
    return 1.0 - missed / max(float((y**2).sum()), 1e-300)
