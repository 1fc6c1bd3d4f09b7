"""Which numbers a response needs at all."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np

from afm_rl.diagnosis.intervals import half_widths
from afm_rl.diagnosis.lines import left_by, with_one
from afm_rl.diagnosis.model import (
    DOWN,
    GAIN_DRIFT,
    OFFSET_DRIFT,
    Model,
    Problem,
    costs,
    cut,
    fit_lines,
    lost,
    rows_of,
    scale_of,
    weight_of,
)
from afm_rl.diagnosis.refine import refine
from afm_rl.diagnosis.response import Shape, look_back, respond
from afm_rl.diagnosis.settings import Settings

COST = attrgetter("cost")
NONE = Shape._field_defaults


def fit_response(problem: Problem, large: Problem, driver: int, starts: Sequence[Shape]) -> Model:
    """Return the simplest model that is not clearly worse than a more complicated one.

    Delay, lag and rate limit together first; then forward, whichever of the other numbers and
    commands improves the fit most, as long as it improves it clearly; then backward, what is no
    longer needed.
    """
    most = min(problem.settings.most, int(problem.use.sum()) // 10)
    whole = large
    options = [model for model in _dynamics(problem, driver, starts) if model.size <= most]
    if rows_of(problem, options[-1]) > problem.settings.enough:
        large = problem
    if large is not problem:
        options = refine(large, options)
    model = _simplest(large, options)
    added = 0
    # A drift last, since it explains a little of everything.
    for steps in ((larger, _with_another), (_with_drift,)):
        while added < most:
            larger_ones = chain.from_iterable(step(problem, model) for step in steps)
            refined = refine(large, list(larger_ones))
            better = _usual(large, refined, model)
            if not (needed(large, better, model) and _visible(large, better, model)):
                break
            model, added = better, added + 1
    model = _smaller(large, model) if added else model
    return model if whole is large else refine(whole, [model])[0]


def _dynamics(problem: Problem, driver: int, starts: Sequence[Shape]) -> list[Model]:
    """Return the best models with none, some, and all of delay, lag and rate limit."""
    options = [Model(driver, Shape())]
    for start in starts:
        kinds = ("delay", "keep", "rate")
        names = tuple(name for name in kinds if getattr(start, name) != NONE[name])
        delayed = ("delay", *(name for name in names if name != "delay"))
        for active in dict.fromkeys((names, delayed, delayed[1:], ("delay",))):
            shape = Shape(**{name: getattr(start, name) for name in active})
            options.append(Model(driver, shape, active))
    best = {
        model.active: model for model in sorted(fit_lines(problem, options), key=COST, reverse=True)
    }
    models = refine(problem, [model for model in best.values() if model.shape.rate == math.inf])
    least = min(model.cost for model in models)
    limited = [model for model in best.values() if model.shape.rate < math.inf]
    models += refine(problem, [model for model in limited if model.cost < 2 * least])
    return sorted(models, key=lambda model: (model.size, -model.cost))


def _simplest(problem: Problem, models: Sequence[Model]) -> Model:
    """Return the simplest of some models that is not clearly worse than a larger one."""
    first, *others = models
    for size in sorted({other.size for other in others}):
        alike = _alike(problem, [other for other in others if other.size == size])
        better = min(alike, key=lambda m: ("rate" in m.active, "delay" not in m.active, m.cost))
        if better.size > first.size and needed(problem, better, first):
            first = better
    return first


def _alike(problem: Problem, models: Sequence[Model]) -> list[Model]:
    """Return those of some models that are not clearly worse than the best."""
    best = min(models, key=COST)
    rows = rows_of(problem, best)
    return [model for model in models if lost(rows, model.cost, best.cost) < 4]


def with_gain(problem: Problem, model: Model, gain: float) -> Model:
    """Return the model of a limited rate with another gain, if that explains as much.

    What never arrives does not show how far it would go.
    """
    if "rate" not in model.active or not 0 < model.gain:
        return model
    shape = model.shape._replace(rate=model.shape.rate * model.gain / gain)
    other = replace(model, gain=gain, shape=shape)
    residual = other.residual(problem)
    shift = float(np.median(residual))
    cost = float(costs(residual - shift).mean())
    rows = rows_of(problem, model)
    if lost(rows, cost, model.cost) > problem.settings.price(rows):
        return model
    return replace(other, offset=other.offset + shift, cost=cost)


def _usual(problem: Problem, models: Sequence[Model], default: Model) -> Model:
    """Return the best of some models; one that takes over each command, if that is as good.

    Where commands hold for some rows, one of so many is taken over, or each is late.
    """
    if not models:
        return default
    best = min(models, key=COST)
    if "hold" in best.active and "hold" not in default.active:
        rest = tuple(name for name in best.active if name not in ("hold", "phase", "delay"))
        late = best.with_shape(("delay", *rest), hold=1, phase=0)
        delays = [{"delay": best.shape.delay + k} for k in range(1, best.shape.hold)]
        models = [*models, *refine(problem, [_best(problem, late, delays)])]
    alike = _alike(problem, models)
    return min(alike, key=lambda model: ("hold" in model.active, model.cost))


def needed(problem: Problem, large: Model, small: Model) -> bool:
    """Return whether a model wins enough likelihood by the numbers that it has more.

    Neighbouring residuals that are alike count as fewer rows; and the model has to be better all
    over the log, not in one place, nor by one row.
    """
    residuals = [model.residual(problem) for model in (small, large)]
    before, after = (costs(residual, scale_of(residuals[1])) for residual in residuals)
    gain, rows = before - after, rows_of(problem, large)
    others = np.arange(len(gain)) != gain.argmax()
    won = lost(rows, small.cost, large.cost)
    won = min(won, lost(rows, before[others].mean(), after[others].mean()))
    others = problem.u.shape[1] if len(large.others) > len(small.others) else 1
    chance = 2 * math.log(others)  # another command is the best of many
    enough = problem.settings.price(rows) * (large.size - small.size) + chance
    return won > enough and consistent(gain, problem.settings, math.sqrt(chance))


def consistent(gain: np.ndarray, settings: Settings, chance: float = 0.0) -> bool:
    """Return whether what rows gain is above 0 in most blocks of a log.

    By ``chance`` standard errors more, where it is the best of many.
    """
    count = min(settings.blocks, len(gain) // 3)
    if count < 2:
        return False
    blocks = np.array([block.mean() for block in np.array_split(gain, count)])
    error = blocks.std(ddof=1) / math.sqrt(len(blocks))
    return bool(blocks.mean() > (settings.consistent + 0.5 * chance) * error)


def _visible(problem: Problem, one: Model, other: Model) -> bool:
    apart = (one.predict(problem) - other.predict(problem))[problem.use]
    return bool(apart.std() > problem.settings.visible)


def _with_drift(problem: Problem, model: Model) -> Iterator[Model]:
    """Yield the model with a gain, or an offset, that drifts, as far as that may be needed."""
    rows = rows_of(problem, model)
    for kind in {GAIN_DRIFT, OFFSET_DRIFT} - {*model.others}:
        (other,) = fit_lines(problem, [model.beside(kind)])
        if lost(rows, model.cost, other.cost) > 0.5 * problem.settings.price(rows):
            yield other


def larger(problem: Problem, model: Model, tried: int = 3) -> Iterator[Model]:
    """Yield the best models of the own command with one number more, from a good beginning."""
    own = problem.u[:, model.driver]
    beginnings = _beginnings(own, model.shape)
    if weight_of(problem, model) > 0.8:  # a limit would leave neighbours that are alike
        beginnings.pop("rate", None)
    options = [
        (names, begin.with_shape((*begin.active, *names.split()), **numbers))
        for names, grid in beginnings.items()
        for begin in _bases(model, names)
        for numbers in grid
    ]
    fitted = fit_lines(problem, [other for _, other in options])
    best: dict[str, Model] = {}
    for (names, _), other in zip(options, fitted, strict=True):
        best[names] = min(best.get(names, other), other, key=COST)
    models = list(best.values())
    up, down = ((own[side & problem.use] ** 2).sum() for side in (own > 0, own < 0))
    if min(up, down) > 0.05 * max(up, down) and DOWN not in model.others:
        models += fit_lines(problem, [model.beside(DOWN)])
    for other in sorted(models, key=COST)[:tried]:
        for width in (0.12, 0.03):
            for name in {"jump", "stick"} & {*other.active} - {*model.active}:
                near = getattr(other.shape, name) * np.linspace(1 - width, 1 + width, 9)
                other = min(
                    other, _best(problem, other, [{name: x} for x in near.tolist()]), key=COST
                )
        yield other


def _beginnings(own: np.ndarray, shape: Shape) -> dict[str, list[dict[str, Any]]]:
    """Return values to begin with, for each number that a shape does not have yet."""
    sizes = np.abs(own)
    low, high = (float(x) for x in np.quantile(own, [0.02, 0.98]))
    inwards = (high - low) * np.array([0.08, 0.16, 0.25, 0.35, 0.45])
    grids: dict[str, Any] = {
        "delay": (0.5, 1.0, 2.0, 4.0),
        "keep": (0.4, 0.65, 0.85),
        "cut": np.quantile(sizes, 0.98) * np.array([0.03, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9]),
        "low": low + inwards,
        "high": high - inwards,
        "play": (high - low) * np.array([0.02, 0.05, 0.1, 0.18, 0.28]),
        "stick": float(sizes.max()) * np.geomspace(0.03, 0.8, 14),
    }
    taken = {name for name, value in shape._asdict().items() if value != NONE[name]}
    if taken & {"delay", "keep"}:  # it looks like these
        grids["rate"] = (0.8, 0.5, 0.3, 0.15, 0.08)
    if low < 0 < high and not shape.dead_zone and not shape.jump:
        grids["dead_zone"] = np.quantile(sizes, 0.98) * np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.7])
        grids["jump"] = grids["stick"]
    found = {
        name: [{name: float(value)} for value in values]
        for name, values in grids.items()
        if name not in taken
    }
    if taken & {"low", "high"}:
        found.pop("cut", None)
    if "cut" in taken:
        found = {name: options for name, options in found.items() if name not in ("low", "high")}
    elif not {"low", "high"} & taken:
        found["low high"] = [
            {"low": float(a), "high": float(b)}
            for a, b in zip(grids["low"], grids["high"], strict=True)
        ]
    if "hold" not in taken:
        holds = (2, 3, 4, 5, 6, 8, 10)  # rows
        found["hold phase"] = [{"hold": n, "phase": k} for n in holds for k in range(n)]
    return found


def _bases(model: Model, names: str) -> Iterator[Model]:
    """Yield the model, and what may stand in the place of its delay and lag."""
    if names != "rate" or "keep" not in model.active:  # a limit looks like a lag
        yield model
    rest = tuple(name for name in model.active if name not in ("delay", "keep"))
    # Some may be mistaken for delay and lag.
    if names.split()[0] not in ("play", "stick", "hold", "rate") or len(rest) == len(model.active):
        return
    yield model.with_shape(rest, delay=0.0, keep=0.0)
    delay = round(model.shape.delay)
    for late in range(max(delay - 2, 1), delay + 1) if names in ("hold phase", "rate") else ():
        yield model.with_shape((*rest, "delay"), delay=float(late), keep=0.0)


def _best(problem: Problem, model: Model, options: Sequence[dict[str, Any]]) -> Model:
    models = [model.with_shape(model.active, **option) for option in options]
    return min(fit_lines(problem, models), key=COST)


def _with_another(
    problem: Problem, model: Model, clear: float = 4.5, coupled: float = 0.05
) -> Iterator[Model]:
    """Yield the model with the other command that shows best in what is left.

    What the own command may explain a few steps earlier or later does not count: neighbours that
    are commanded alike would stand in for dynamics that are not known.
    """
    linear, around = model.shape.linear, (-2, -1, 0, 1, 2, 4, 8)  # steps
    use = problem.use
    taken = (model.driver, *model.others)
    rest = [i for i, moves in enumerate(problem.u.std(0)) if moves > 0 and i not in taken]
    if not rest:
        return
    parts = [x[use] for x in model.parts(problem)]
    own = problem.u[:, model.driver]
    late = [linear._replace(delay=linear.delay + k) for k in around]
    parts += [look_back(problem.clock, own, shape)[use] for shape in late]
    design = with_one(*parts)
    others = respond(problem.clock, problem.u[:, rest], linear)[use]
    raw, both = others, left_by(design, np.column_stack([others, model.residual(problem)]))
    others, residual = both[:, :-1], cut(both[:, -1])
    power = (others**2).sum(0)
    slope = residual @ others / np.maximum(power, 1e-300)
    spread = problem.u[:, rest].std(0)
    independent = power / len(residual) > 0.02 * spread**2  # hardly a copy
    influence = np.abs(slope) * spread
    main = abs(model.gain) * parts[0].std()
    remaining = residual[:, None] - slope * others  # of each, were it the one
    error = half_widths(remaining * others / np.maximum(power, 1e-300), chosen=1.0) / 1.96
    good = independent & (np.abs(slope) > clear * error) & (influence > coupled * main)
    won = np.where(good, slope**2 * power, 0.0)
    best = int(won.argmax())
    if won[best] > 2 * _by_chance(raw, residual, design):
        yield model.beside(rest[best], float(slope[best]))


def _by_chance(
    others: np.ndarray, residual: np.ndarray, design: np.ndarray, shifts: int = 12
) -> float:
    """Return what the best of other commands ``(N, A)`` wins where it cannot act.

    That is what it wins when it is moved along the log, of as many places the most: slow series
    that have nothing to do with each other look alike.
    """
    most = 0.0
    for k in range(1, shifts):
        moved = left_by(design, np.roll(others, k * len(others) // shifts, axis=0))
        most = max(most, float(((residual @ moved) ** 2 / ((moved**2).sum(0) + 1e-300)).max()))
    return most


def _smaller(problem: Problem, model: Model) -> Model:
    """Leave out numbers that are not needed any more, one at a time."""
    while True:
        models = []
        for name in (name for name in model.active if name != "phase"):
            left_out = ("hold", "phase") if name == "hold" else (name,)
            active = (name for name in model.active if name not in left_out)
            smaller = model.with_shape(active, **{name: NONE[name] for name in left_out})
            models.append(smaller)
        better = min(refine(problem, models), key=COST, default=model)
        if better is model or needed(problem, model, better):
            return model
        model = better
