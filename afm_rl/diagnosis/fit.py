"""Which numbers a response needs at all."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np

from afm_rl.diagnosis.intervals import half_widths
from afm_rl.diagnosis.model import DOWN, Model, Problem, cut, fit_lines, refine, weight_of
from afm_rl.diagnosis.response import Shape, respond

PENALTY = 10.0  # per number: twice the logarithm of the likelihood that it has to win
VISIBLE = 0.02  # standard deviations of the response: what changes it less is left out
FLOOR = 1e-7  # share of the variance: better fits are all the same
MOST = 6  # numbers beside delay and lag
REFINED = 3  # models with another number, of which the best numbers are looked for
CLEAR = 4.5  # standard errors by which another command has to show
COUPLED = 0.05  # share of the driver's influence
QUICK = ("play", "stick", "rate", "hold")  # may be mistaken for delay and lag
HOLDS = (2, 3, 4, 5, 6, 8, 10)  # rows
COST = attrgetter("cost")
NONE = Shape._field_defaults


def fit_response(problem: Problem, driver: int, starts: Sequence[Shape]) -> Model:
    """Return the simplest model that is not clearly worse than a more complicated one.

    Forward: delay and lag, then the other numbers of a shape and other commands, whichever improves
    the fit most, as long as it improves it clearly. Backward: what is no longer needed is left out.

    Args:
        problem: response and commands.
        driver: the command that is followed.
        starts: delays and lags to begin with.
    """
    model = _dynamics(problem, driver, starts)
    for added in range(MOST):
        found = [refine(problem, candidate) for candidate in larger(problem, model)]
        better = min(found, key=COST, default=model)
        if not (_needed(problem, better, model) and _visible(problem, better, model)):
            return _smaller(problem, model) if added else model
        model = better
    return _smaller(problem, model)


def _dynamics(problem: Problem, driver: int, starts: Sequence[Shape]) -> Model:
    """Return the simplest of no delay, a delay, a lag, and both that is needed."""
    options = []
    for start in starts:
        options.append(Model(driver, start._replace(keep=0.0), ("delay",)))
        if start.keep:
            options.append(Model(driver, start, ("delay", "keep")))
            options.append(Model(driver, start._replace(delay=0.0), ("keep",)))
    model = refine(problem, Model(driver, Shape()))
    for size in (1, 2):
        some = [refine(problem, option) for option in options if option.size == size]
        better = min(some, key=COST, default=model)
        if better.size > model.size and _needed(problem, better, model):
            model = better
    return model


def _needed(problem: Problem, larger: Model, smaller: Model) -> bool:
    """Return whether a model wins enough likelihood by the numbers that it has more.

    Neighbouring residuals that are alike count as fewer rows.
    """
    rows = problem.use.sum() * weight_of(problem, larger)
    won = rows * math.log((smaller.cost + FLOOR) / (larger.cost + FLOOR))
    return won > PENALTY * (larger.size - smaller.size)


def _visible(problem: Problem, one: Model, other: Model) -> bool:
    apart = (one.predict(problem) - other.predict(problem))[problem.use]
    return bool(apart.std() > VISIBLE)


def larger(problem: Problem, model: Model) -> Iterator[Model]:
    """Yield models with one number more, each with a good beginning for it."""
    own, shape = problem.u[:, model.driver], model.shape
    found = []
    for names, options in _beginnings(own, shape).items():
        for begin in _bases(model, names):
            trial = replace(begin, active=(*begin.active, *names.split()))
            best = _best(problem, trial, options)
            for width in (0.12, 0.03) if names in ("jump", "stick") else ():
                near = getattr(best.shape, names) * np.linspace(1 - width, 1 + width, 9)
                best = min(best, _best(problem, best, [{names: float(x)} for x in near]), key=COST)
            found.append(best)
    if own.min() < 0 < own.max() and DOWN not in model.others:
        sides = replace(model, others=(*model.others, DOWN), gains=(*model.gains, 0.0))
        found.append(fit_lines(problem, sides))
    yield from sorted(found, key=COST)[:REFINED]
    yield from _with_another(problem, model)


def _beginnings(own: np.ndarray, shape: Shape) -> dict[str, list[dict[str, Any]]]:
    """Return values to begin with, for each number that a shape does not have yet."""
    sizes = np.abs(own)
    low, high = (float(x) for x in np.quantile(own, [0.02, 0.98]))
    grids: dict[str, Any] = {
        "delay": (0.5, 1.0, 2.0, 4.0),
        "keep": (0.4, 0.65, 0.85),
        "low": low + (high - low) * np.array([0.08, 0.16, 0.25, 0.35, 0.45]),
        "high": high - (high - low) * np.array([0.08, 0.16, 0.25, 0.35, 0.45]),
        "play": (high - low) * np.array([0.02, 0.05, 0.1, 0.18, 0.28]),
        "stick": float(sizes.max()) * np.geomspace(0.03, 0.8, 18),
        "rate": np.geomspace(0.01, 1.0, 10),
    }
    if low < 0 < high and not shape.dead_zone and not shape.jump:
        grids["dead_zone"] = np.quantile(sizes, 0.98) * np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.7])
        grids["jump"] = grids["stick"]
    taken = {name for name, value in shape._asdict().items() if value != NONE[name]}
    found = {
        name: [{name: float(value)} for value in values]
        for name, values in grids.items()
        if name not in taken
    }
    if not {"low", "high"} & taken:
        found["low high"] = [
            {"low": float(a), "high": float(b)}
            for a, b in zip(grids["low"], grids["high"], strict=True)
        ]
        if low < 0 < high:  # a switch
            found["low high"].append({"low": 0.03 * low, "high": 0.03 * high})
    if "hold" not in taken:
        found["hold phase"] = [{"hold": n, "phase": k} for n in HOLDS for k in range(n)]
    return found


def _bases(model: Model, names: str) -> Iterator[Model]:
    """Yield the model, and what may stand in the place of its delay and lag."""
    yield model
    rest = tuple(name for name in model.active if name not in ("delay", "keep"))
    if names.split()[0] not in QUICK or len(rest) == len(model.active):
        return
    yield replace(model, active=rest, shape=model.shape._replace(delay=0.0, keep=0.0))
    delay = round(model.shape.delay)
    for late in range(max(delay - 2, 1) if names == "hold phase" else max(delay, 1), delay + 1):
        shape = model.shape._replace(delay=float(late), keep=0.0)
        yield replace(model, active=(*rest, "delay"), shape=shape)


def _best(problem: Problem, model: Model, options: Sequence[dict[str, Any]]) -> Model:
    shapes = (model.shape._replace(**option) for option in options)
    return min((fit_lines(problem, replace(model, shape=shape)) for shape in shapes), key=COST)


def _with_another(problem: Problem, model: Model) -> Iterator[Model]:
    """Yield the model with the other command that shows best in what is left."""
    linear = model.shape.linear
    rest = [i for i in range(problem.u.shape[1]) if i not in (model.driver, *model.others)]
    rest = [i for i in rest if problem.u[:, i].std() > 0]
    if not rest:
        return
    use = problem.use
    parts = [x[use] for x in model.parts(problem)]
    design = np.column_stack([*parts, np.ones(use.sum())])
    others = np.column_stack([respond(problem.clock, problem.u[:, i], linear)[use] for i in rest])
    residual = problem.y[use] - model.predict(problem)[use]
    both = np.column_stack([others, residual])
    both -= design @ np.linalg.lstsq(design, both, rcond=None)[0]
    others, residual = both[:, :-1], cut(both[:, -1])
    power = (others**2).sum(0)
    slope = residual @ others / np.maximum(power, 1e-300)
    spread = problem.u[:, rest].std(0)
    kept = power / len(residual) > 1e-4 * spread**2  # not a copy of the driver
    influence = np.abs(slope) * spread
    main = abs(model.gain) * parts[0].std()
    left = residual[:, None] - slope * others  # of each, were it the one
    error = half_widths(left * others / np.maximum(power, 1e-300)) / 1.96
    good = kept & (np.abs(slope) > CLEAR * error) & (influence > COUPLED * main)
    if good.any():
        best = int(np.argmax(np.where(good, slope**2 * power, -1.0)))
        yield replace(
            model,
            others=(*model.others, rest[best]),
            gains=(*model.gains, float(slope[best])),
        )


def _smaller(problem: Problem, model: Model) -> Model:
    """Leave out numbers that are not needed any more, one at a time."""
    while True:
        options = [
            replace(
                model,
                active=tuple(name for name in model.active if name not in left_out),
                shape=model.shape._replace(**{name: NONE[name] for name in left_out}),
            )
            for left_out in _removable(model)
        ]
        found = [refine(problem, option) for option in options]
        better = min(found, key=COST, default=model)
        if better is model or _needed(problem, model, better):
            return model
        model = better


def _removable(model: Model) -> Iterator[tuple[str, ...]]:
    for name in model.active:
        if name != "phase":
            yield ("hold", "phase") if name == "hold" else (name,)
