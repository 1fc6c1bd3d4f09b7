"""A model of a response, and the best numbers for it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from afm_rl.diagnosis.intervals import half_widths, independence
from afm_rl.diagnosis.lines import ridge, with_one
from afm_rl.diagnosis.log import Clock
from afm_rl.diagnosis.response import Shape, lagging, respond, shaped
from afm_rl.diagnosis.settings import Settings

DOWN, GAIN_DRIFT, OFFSET_DRIFT = -1, -2, -3
"""Among the others: the response of negative commands, that times the time, and the time."""
FLOOR = 1e-5  # share of the variance: better fits are all the same


@dataclass(frozen=True)
class Problem:
    """One response and all commands, in units of their spread.

    Args:
        clock: of the rows.
        u: commands ``(N, A)``, in half ranges.
        y: response ``(N,)``, in standard deviations.
        use: which rows count, ``(N,)``.
        time: of the rows, -0.5 to 0.5, ``(N,)``.
        begin: where each episode begins, in units of the driver, ``(N,)``; None: at its command.
        at_rest: rows without a command and a response that are known beside these; a few at most.
        settings: the thresholds.
    """

    clock: Clock
    u: np.ndarray
    y: np.ndarray
    use: np.ndarray
    time: np.ndarray
    begin: np.ndarray | None = None
    at_rest: float = 0.0
    settings: Settings = Settings()


@dataclass(frozen=True)
class Model:
    """What explains a response: gain, offset, a shape, and other commands."""

    driver: int
    shape: Shape
    active: tuple[str, ...] = ()
    """Which numbers of the shape are estimated."""
    gain: float = 0.0
    offset: float = 0.0
    others: tuple[int, ...] = ()
    gains: tuple[float, ...] = ()
    """Of the others."""
    cost: float = math.inf

    @property
    def size(self) -> int:
        """Count the numbers that are estimated."""
        return len(self.active) + len(self.others)

    @property
    def smooth(self) -> tuple[str, ...]:
        """Of the active numbers, those by which the response has derivatives."""
        stepped = ("jump", "stick", "hold", "phase")  # the response changes by jumps with these
        return tuple(name for name in self.active if name not in stepped)

    def parts(self, problem: Problem) -> list[np.ndarray]:
        """Return the responses at gain 1 to the driver and to the others, ``(N,)`` each."""
        clock, keep = problem.clock, self.shape.keep
        before = shaped(clock, problem.u[:, self.driver], self.shape, problem.begin)
        own = lagging(clock, before, keep)
        odd = {
            DOWN: lambda: lagging(clock, np.minimum(before, 0.0), keep),
            GAIN_DRIFT: lambda: own * problem.time,
            OFFSET_DRIFT: lambda: problem.time,
        }
        linear = self.shape.linear
        others = (
            odd[i]() if i < 0 else respond(clock, problem.u[:, i], linear) for i in self.others
        )
        return [own, *others]

    def led_by(self, own: int) -> Model:
        """Return the model with another of its commands as the driver, where both act alike."""
        curved = {"dead_zone", "cut", "low", "high", "play", "jump", "stick", "rate"}
        if own not in self.others or min(self.others) < 0 or curved & {*self.active}:
            return self
        gains = {self.driver: self.gain, **dict(zip(self.others, self.gains, strict=True))}
        gain = gains.pop(own)
        return replace(
            self, driver=own, gain=gain, others=tuple(gains), gains=tuple(gains.values())
        )

    def beside(self, other: int, gain: float = 0.0) -> Model:
        """Return the model with the response to one more command, or one of the odd ones."""
        return replace(self, others=(*self.others, other), gains=(*self.gains, gain))

    def with_shape(self, active: Iterable[str], **numbers: Any) -> Model:
        """Return the model with other numbers of the shape, of which some are estimated."""
        return replace(self, active=tuple(active), shape=self.shape._replace(**numbers))

    def mixed(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the response ``(N,)`` that consists of some :meth:`parts`."""
        gains = (self.gain, *self.gains)
        return self.offset + np.sum([g * x for g, x in zip(gains, parts, strict=True)], 0)

    def predict(self, problem: Problem) -> np.ndarray:
        """Return the response ``(N,)``."""
        return self.mixed(self.parts(problem))

    def residual(self, problem: Problem) -> np.ndarray:
        """Return what is left of the response, of the rows that count."""
        return (problem.y - self.predict(problem))[problem.use]


def weight_of(problem: Problem, model: Model) -> float:
    """Return how many independent rows a row counts as, by what a model leaves."""
    return max(independence(cut(model.residual(problem))), 0.002)


def rows_of(problem: Problem, model: Model) -> float:
    """Return how many independent rows there are, by what a model leaves."""
    return problem.use.sum() * weight_of(problem, model)


def lost(rows: float, cost: float, least: float) -> float:
    """Return twice the log-likelihood that an explanation of a cost lacks beside another one."""
    return rows * math.log((cost + FLOOR) / (least + FLOOR))


def cut(residual: np.ndarray) -> np.ndarray:
    """Return residuals, large ones made smaller."""
    scale = 4 * scale_of(residual)
    return np.clip(residual, -scale, scale) if scale > 0 else residual


def scale_of(residual: np.ndarray) -> float:
    """Return the standard deviation of residuals, whatever a tenth of them is.

    By their 85 % quantile: the median would take every transient of a step for an outlier.
    """
    return float(np.quantile(np.abs(residual), 0.85)) / 1.4395


def costs(residual: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Return squares, but where residuals are far beyond the scale rather their sizes."""
    scale = 2.0 * max(scale_of(residual) if scale is None else scale, math.sqrt(FLOOR))
    return 2 * residual**2 / (np.sqrt(1 + (residual / scale) ** 2) + 1)


def fit_lines(problem: Problem, model: Model, rounds: int = 0) -> Model:
    """Return the model with the best gains and offset for its shape.

    Each round takes weight from residuals that are large.
    """
    use = problem.use
    heavy = design = with_one(*(x[use] for x in model.parts(problem)))
    y = problem.y[use]
    for later in reversed(range(rounds + 1)):
        gram = heavy.T @ design
        gram[-1, -1] += problem.at_rest
        solution = ridge(gram, heavy.T @ y, 1e-12)
        residual = y - design @ solution
        if not later or not (scale := 2.0 * scale_of(residual)) > 1e-9:
            break
        heavy = design / np.sqrt(1 + (residual / scale) ** 2)[:, None]
    gain, *gains, offset = map(float, solution)
    cost = float(costs(residual).mean())
    return replace(model, gain=gain, offset=offset, gains=tuple(gains), cost=cost)


def refine(problem: Problem, model: Model) -> Model:
    """Return the model with the best numbers near those that it has."""
    model = fit_lines(problem, model, 2)
    if not model.smooth:
        return model
    use = problem.use
    own = problem.u[:, model.driver]
    most = max(float(np.abs(own).max()), 1e-6)
    scale = max(2.0 * scale_of(model.residual(problem)), 1e-4)
    limits = dict.fromkeys(("dead_zone", "play", "cut"), (0.0, most))
    limits |= dict.fromkeys(("low", "high"), (-most, most))
    limits |= {"rate": (min(1e-3, most), 2 * most), "keep": (0.0, 0.99)}
    longest = max(60.0, 1.5 * model.shape.delay)
    limits["delay"] = (-60.0, 0.0) if model.shape.delay < 0 else (0.0, longest)
    ends = np.array([limits[name] for name in model.smooth]).T
    wide = np.full(2 + len(model.others), np.inf)
    low, high = np.concatenate([-wide, ends[0]]), np.concatenate([wide, ends[1]])

    def miss(values: np.ndarray) -> np.ndarray:
        return -_with_values(model, values).residual(problem)

    def slope(values: np.ndarray) -> np.ndarray:
        return slopes(problem, _with_values(model, values), central=False)[use]

    begin = np.clip(values_of(model), low + 1e-9, high - 1e-9)
    solution = least_squares(
        miss,
        begin,
        slope,
        bounds=(low, high),
        loss="soft_l1",
        f_scale=scale,
        max_nfev=12,
        ftol=1e-6,
        xtol=1e-6,
    )
    better = fit_lines(problem, _with_values(model, solution.x), 2)
    return better if better.cost < model.cost else model


def values_of(model: Model) -> np.ndarray:
    """Return gain, offset, the others' gains, and the smooth numbers of the shape."""
    shape = [getattr(model.shape, name) for name in model.smooth]
    return np.array([model.gain, model.offset, *model.gains, *shape])


def _with_values(model: Model, values: np.ndarray) -> Model:
    gain, offset, *numbers = map(float, values)
    count = len(model.others)
    shape: Any = dict(zip(model.smooth, numbers[count:], strict=True))
    model = model.with_shape(model.active, **shape)
    return replace(model, gain=gain, offset=offset, gains=tuple(numbers[:count]))


def slopes(problem: Problem, model: Model, central: bool = True) -> np.ndarray:
    """Return derivatives of the prediction by :func:`values_of`, ``(N, P)``."""
    parts = model.parts(problem)
    middle = model.mixed(parts)
    columns = [parts[0], np.ones(len(problem.y)), *parts[1:]]
    for name in model.smooth:
        here, width = getattr(model.shape, name), {"delay": 0.05, "rate": 0.003}.get(name, 0.01)
        lowest = -math.inf if here < 0 or name in ("low", "high") else 0.0
        up = min(here + width, 0.995) if name == "keep" else here + width
        down = max(here - width, lowest) if central else here
        upper, lower = (
            middle if x == here else model.with_shape(model.active, **{name: x}).predict(problem)
            for x in (up, down)
        )
        columns.append((upper - lower) / (up - down))
    return np.column_stack(columns)


def interval_widths(problem: Problem, model: Model, middle: float = 0.0) -> np.ndarray:
    """Return half widths of the 95 % intervals of four numbers, ``(4,)``.

    These are the gain, the responses to the commands 0 and ``middle``, and delay and lag together
    (steps). The uncertainty of a delay that was found to be none counts, too.
    """
    if not {"delay", "keep"} & set(model.active):
        model = replace(model, active=(*model.active, "delay"))
    use = problem.use
    columns = slopes(problem, model)[use]
    residual = model.residual(problem)
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
