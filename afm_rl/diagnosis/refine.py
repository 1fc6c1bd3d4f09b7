"""The best numbers of models, and how well these are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.intervals import half_widths
from afm_rl.diagnosis.model import Model, Problem, fit_lines, scale_of
from afm_rl.diagnosis.response import stacked

Names = tuple[str, ...]


def refine(problem: Problem, models: Sequence[Model]) -> list[Model]:
    """Return models with the best numbers near those that they have."""
    refined = list(models)
    for commands in {(model.driver, model.others) for model in models}:
        places = [k for k, model in enumerate(models) if (model.driver, model.others) == commands]
        fitted = fit_lines(problem, [models[k] for k in places], 2)
        smooth = [k for k, model in zip(places, fitted, strict=True) if model.smooth]
        for k, model in zip(places, fitted, strict=True):
            refined[k] = model
        better = _descended(problem, [refined[k] for k in smooth]) if smooth else []
        for k, model in zip(smooth, better, strict=True):
            refined[k] = min(refined[k], model, key=lambda model: model.cost)
    return refined


def _descended(problem: Problem, models: Sequence[Model], most: int = 12) -> list[Model]:
    r"""Return models with the numbers that minimise :math:`\sum_k \sqrt{1 + (e_k / s)^2}`.

    With the residuals e and their scale s at the begin, by the method of Levenberg and Marquardt,
    within bounds, for all models at once.
    """
    use, names = problem.use, tuple(dict.fromkeys(name for m in models for name in m.smooth))
    low, high = np.moveaxis(np.array([_bounds(problem, model, names) for model in models]), 1, 0)
    values = np.clip([_values(model, names) for model in models], low, high)

    def look(places: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs = zip(places, values, strict=True)
        trials = [_with_values(models[place], names, numbers) for place, numbers in pairs]
        predicted, slope = slopes(problem, trials, names)
        return (problem.y - predicted)[:, use], slope[:, use]

    residual, slope = look(np.arange(len(models)), values)
    scale = np.maximum(2.0 * scale_of(residual), 1e-4)[:, None]
    damping, going = np.full(len(models), 1e-3), np.ones(len(models), dtype=bool)
    for _ in range(most):
        now = np.flatnonzero(going)
        root = np.sqrt(1 + (residual[now] / scale[now]) ** 2)
        pull = ((residual[now] / root)[:, None] @ slope[now])[:, 0]
        held = (values[now] <= low[now]) & (pull < 0) | (values[now] >= high[now]) & (pull > 0)
        free = slope[now] * ~held[:, None]
        gram = (free / root[..., None]).mT @ free
        size = np.diagonal(gram, axis1=1, axis2=2)
        ridge = np.where(size > 0, damping[now, None] * size, 1.0)[..., None] * np.eye(len(low.T))
        step = np.linalg.solve(gram + ridge, (pull * ~held)[..., None])[..., 0]
        trial = np.clip(values[now] + step, low[now], high[now])
        there, slope_there = look(now, trial)
        before = root.mean(1)
        better = np.sqrt(1 + (there / scale[now]) ** 2).mean(1) < before
        values[now[better]] = trial[better]
        residual[now[better]], slope[now[better]] = there[better], slope_there[better]
        damping[now] *= np.where(better, 0.1, 30.0)
        hoped = (pull * ~held * step).sum(1) / root.shape[1] / scale[now, 0] ** 2
        going[now] = (hoped > 1e-5 * (before - 1)) & (damping[now] < 1e3)
        if not going.any():
            break
    best = [_with_values(model, names, own) for model, own in zip(models, values, strict=True)]
    return fit_lines(problem, best, 2)


def _bounds(problem: Problem, model: Model, names: Names) -> tuple[list[float], list[float]]:
    """Return the lowest and the highest of the values of a model."""
    most = max(float(np.abs(problem.u[:, model.driver]).max()), 1e-6)
    limits = dict.fromkeys(("dead_zone", "play", "cut"), (0.0, most))
    limits |= dict.fromkeys(("low", "high"), (-most, most))
    limits |= {"rate": (min(1e-3, most), 2 * most), "keep": (0.0, 0.99)}
    longest = max(60.0, 1.5 * model.shape.delay)
    limits["delay"] = (-60.0, 0.0) if model.shape.delay < 0 else (0.0, longest)
    free = (-math.inf, math.inf)
    ends = [free] * (2 + len(model.others))
    ends += [limits[name] if name in model.smooth else free for name in names]
    return [low for low, _ in ends], [high for _, high in ends]


def _values(model: Model, names: Names) -> list[float]:
    """Return gain, offset, the others' gains, and some numbers of the shape."""
    return [model.gain, model.offset, *model.gains, *(getattr(model.shape, n) for n in names)]


def _with_values(model: Model, names: Names, values: np.ndarray) -> Model:
    gain, offset, *numbers = values.tolist()
    count = len(model.others)
    shape = dict(zip(names, numbers[count:], strict=True))
    model = model.with_shape(model.active, **{name: shape[name] for name in model.smooth})
    return replace(model, gain=gain, offset=offset, gains=tuple(numbers[:count]))


def slopes(
    problem: Problem, models: Sequence[Model], names: Names
) -> tuple[np.ndarray, np.ndarray]:
    """Return what M models of the same commands predict, ``(M, N)``, and its derivatives.

    ``(M, N, P)``: by gain, offset, the others' gains, and the named numbers of the shape, which are
    0 where a number is not active.
    """
    shapes, owner = [model.shape for model in models], list(range(len(models)))
    pairs = []  # model, number, the places of two shapes, and the difference of this number
    for m, model in enumerate(models):
        for k, name in enumerate(names):
            if name not in model.smooth:
                continue
            here = getattr(model.shape, name)
            by_rows = problem.clock.hold  # the response is, by the delay
            delay = 0.5 if by_rows else 0.1 if "rate" in model.active else 0.05
            width = {"delay": delay, "rate": 0.003}.get(name, 0.01)
            lowest = -math.inf if here < 0 or name in ("low", "high") else 0.0
            up = min(here + width, 0.995) if name == "keep" else here + width
            down = max(here - width, lowest)
            pairs.append((m, k, len(shapes), m if down == here else len(shapes) + 1, up - down))
            for value in (up, down)[: 1 + (down != here)]:
                shapes.append(model.shape._replace(**{name: value}))
                owner.append(m)
    parts = np.stack(models[0].parts(problem, stacked(shapes)), -1).swapaxes(0, 1)
    gains = np.array([(model.gain, *model.gains) for model in models])[owner]
    offsets = np.array([model.offset for model in models])[owner]
    predicted = (parts @ gains[..., None])[..., 0] + offsets[:, None]
    own, lines = parts[: len(models)], 1 + parts.shape[-1]
    slope = np.zeros((len(models), len(problem.y), lines + len(names)))
    slope[..., 0], slope[..., 1], slope[..., 2:lines] = own[..., 0], 1.0, own[..., 1:]
    for m, k, upper, lower, difference in pairs:
        slope[m, :, lines + k] = (predicted[upper] - predicted[lower]) / difference
    return predicted[: len(models)], slope


def interval_widths(problem: Problem, model: Model, middle: float = 0.0) -> np.ndarray:
    """Return half widths of the 95 % intervals of four numbers, ``(4,)``.

    These are the gain, the responses to the commands 0 and ``middle``, and delay and lag together
    (steps). The uncertainty of a delay that was found to be none counts, too.
    """
    if not {"delay", "keep"} & set(model.active):
        model = replace(model, active=(*model.active, "delay"))
    use = problem.use
    predicted, columns = (x[0, use] for x in slopes(problem, [model], model.smooth))
    residual = problem.y[use] - predicted
    scale = 2.0 * scale_of(residual)
    share = (residual / max(scale, 1e-9)) ** 2
    pull = residual / np.sqrt(1 + share)
    stiff = ((1 + share) ** -1.5).mean()
    gram = columns.T @ columns * stiff
    gram[1, 1] += problem.at_rest
    size = np.sqrt(np.maximum(gram.diagonal(), 1e-100))
    unit = gram / np.outer(size, size)
    values, vectors = np.linalg.eigh(unit)
    values = np.maximum(values, 1e-10)
    inverse = (vectors / values) @ vectors.T / size
    freedom = math.sqrt(len(residual) / max(len(residual) - len(size), 1))
    influence = (columns / size * pull[:, None]) @ inverse
    keep = max(model.shape.keep, 0.05)
    steps = {"delay": 1.0, "keep": 1 / (keep * math.log(keep) ** 2)}
    late = influence[:, -len(model.smooth) :] @ [steps.get(name, 0.0) for name in model.smooth]
    gain, offset = influence[:, 0], influence[:, 1]
    four = np.column_stack([gain, offset, offset + middle * gain, late])
    return half_widths(four) * freedom
