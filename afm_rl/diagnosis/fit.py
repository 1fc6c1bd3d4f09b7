"""The numbers of one actuator, and which of them its response needs at all."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from afm_rl.diagnosis.intervals import CHOSEN, half_widths, independence
from afm_rl.diagnosis.log import Clock
from afm_rl.diagnosis.response import Shape, lagging, respond, shaped

PENALTY = 10.0  # per number: twice the logarithm of the likelihood that it has to win
VISIBLE = 0.02  # standard deviations of the response: what changes it less is left out
FLOOR = 1e-7  # share of the variance: better fits are all the same
ROBUST = 2.0  # standard deviations: larger residuals count less
LARGEST = {"delay": 60.0, "keep": 0.99}
STEPS = {"delay": 0.05, "keep": 0.01}  # of numeric derivatives
CURVED = ("dead_zone", "low", "high", "play")
LEAST_WEIGHT = 0.05  # independent rows that a row counts as
CLEAR = 4.5  # standard errors by which another command has to show
COUPLED = 0.05  # share of the driver's influence
DOWN = -1  # among the others: the driver's own command where it is negative


@dataclass(frozen=True)
class Problem:
    """One response and all commands, in units of their spread.

    Args:
        clock: of the rows.
        u: commands ``(N, A)``, in half ranges.
        y: response ``(N,)``, in standard deviations.
        use: which rows count, ``(N,)``.
    """

    clock: Clock
    u: np.ndarray
    y: np.ndarray
    use: np.ndarray


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
    jump: bool = False
    """Do commands beyond the dead zone have their whole effect?"""
    cost: float = math.inf

    @property
    def size(self) -> int:
        """Count the numbers that are estimated."""
        return len(self.active) + len(self.others) + self.jump + (self.shape.stick > 0)

    def parts(self, problem: Problem) -> list[np.ndarray]:
        """Return the responses at gain 1 to the driver and to the others, ``(N,)`` each."""
        linear, clock = Shape(self.shape.delay, self.shape.keep), problem.clock
        own = shaped(clock, problem.u[:, self.driver], self.shape, self.jump)
        others = (
            lagging(clock, np.minimum(own, 0.0), self.shape.keep)
            if i == DOWN
            else respond(clock, problem.u[:, i], linear)
            for i in self.others
        )
        return [lagging(clock, own, self.shape.keep), *others]

    def led_by(self, own: int) -> Model:
        """Return the model with another of its commands as the driver, where both act alike."""
        curved = self.jump or self.shape.stick or DOWN in self.others or {*CURVED} & {*self.active}
        if own not in self.others or curved:
            return self
        gains = {self.driver: self.gain, **dict(zip(self.others, self.gains, strict=True))}
        gain = gains.pop(own)
        return replace(
            self, driver=own, gain=gain, others=tuple(gains), gains=tuple(gains.values())
        )

    def predict(self, problem: Problem) -> np.ndarray:
        """Return the response ``(N,)``."""
        parts = self.parts(problem)
        gains = (self.gain, *self.gains)
        return self.offset + np.sum([g * x for g, x in zip(gains, parts, strict=True)], 0)


def fit_response(problem: Problem, driver: int, starts: Sequence[Shape]) -> Model:
    """Return the simplest model that is not clearly worse than a more complicated one.

    Forward: delay and lag, then dead zone, cuts, play and other commands, whichever improves the
    fit most, as long as it improves it clearly. Backward: what is no longer needed is left out.

    Args:
        problem: response and commands.
        driver: the command that is followed.
        starts: delays and lags to begin with.
    """
    model = _dynamics(problem, driver, starts)
    for added in range(6):
        found = [refine(problem, candidate) for candidate in larger(problem, model)]
        better = min(found, key=_cost, default=model)
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
        better = min(some, key=_cost, default=model)
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


def weight_of(problem: Problem, model: Model) -> float:
    """Return how many independent rows a row counts as, by what a model leaves."""
    residual = (problem.y - model.predict(problem))[problem.use]
    return max(independence(_cut(residual)), LEAST_WEIGHT)


def _visible(problem: Problem, one: Model, other: Model) -> bool:
    apart = (one.predict(problem) - other.predict(problem))[problem.use]
    return bool(apart.std() > VISIBLE)


def larger(problem: Problem, model: Model) -> Iterator[Model]:
    """Yield models with one number more, each with a good beginning for it."""
    own = problem.u[:, model.driver]
    size = np.quantile(np.abs(own), 0.98)
    low, high = np.quantile(own, [0.02, 0.98])
    tries: dict[str, list[float]] = {}
    if low < 0 < high and not model.shape.dead_zone:
        tries["dead_zone"] = [size * share for share in (0.05, 0.1, 0.2, 0.35, 0.5, 0.7)]
    if model.shape.high == np.inf:
        tries["high"] = [high - (high - low) * share for share in (0.08, 0.16, 0.25, 0.35, 0.45)]
    if model.shape.low == -np.inf:
        tries["low"] = [low + (high - low) * share for share in (0.08, 0.16, 0.25, 0.35, 0.45)]
    if not model.shape.play:
        tries["play"] = [(high - low) * share for share in (0.02, 0.05, 0.1, 0.18, 0.28)]
    if "keep" not in model.active:
        tries["keep"] = [0.4, 0.65, 0.85]
    if "delay" not in model.active:
        tries["delay"] = [0.5, 1.0, 2.0, 4.0]
    shapes = {
        name: [model.shape._replace(**{name: value}) for value in values]
        for name, values in tries.items()
    }
    if "high" in tries and "low" in tries:  # both ends at once
        ends = zip(tries["low"], tries["high"], strict=True)
        shapes["low high"] = [model.shape._replace(low=a, high=b) for a, b in ends]
    found = []
    if "play" in tries and {"delay", "keep"} & set(model.active):  # play instead of them
        rest = tuple(name for name in model.active if name not in ("delay", "keep"))
        quick = replace(model, active=(*rest, "play"))
        still = (shape._replace(delay=0.0, keep=0.0) for shape in shapes["play"])
        found.append(min((_lines(problem, replace(quick, shape=s)) for s in still), key=_cost))
    for name, options in shapes.items():
        trial = replace(model, active=(*model.active, *name.split()))
        found.append(min((_lines(problem, replace(trial, shape=s)) for s in options), key=_cost))
    if low < 0 < high and DOWN not in model.others:
        sides = replace(model, others=(*model.others, DOWN), gains=(*model.gains, 0.0))
        found.append(_lines(problem, sides))
    sizes = np.quantile(np.abs(own), np.linspace(0.03, 0.8, 16))
    if "dead_zone" in tries:
        found.append(_by_grid(problem, replace(model, jump=True), "dead_zone", sizes))
    if not model.shape.stick:
        free = tuple(name for name in model.active if name != "play")
        tight = replace(model, active=free, shape=model.shape._replace(play=0.0))
        found.append(_by_grid(problem, tight, "stick", sizes))
    yield from sorted(found, key=_cost)[:2]
    yield from _with_another(problem, model)


def _by_grid(problem: Problem, model: Model, name: str, sizes: np.ndarray) -> Model:
    """Return the model with the best of some sizes, or one close to it: it changes by jumps."""

    def best_of(values: np.ndarray) -> Model:
        shapes = (model.shape._replace(**{name: float(value)}) for value in values)
        return min((_lines(problem, replace(model, shape=s)) for s in shapes), key=_cost)

    coarse = best_of(sizes)
    near = best_of(getattr(coarse.shape, name) * np.linspace(0.88, 1.12, 9))
    return min(coarse, near, key=_cost)


def _cost(model: Model) -> float:
    return model.cost


def _with_another(problem: Problem, model: Model) -> Iterator[Model]:
    """Yield the model with the other command that shows best in what is left."""
    linear = Shape(model.shape.delay, model.shape.keep)
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
    others, residual = both[:, :-1], _cut(both[:, -1])
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
                active=tuple(a for a in model.active if a != name),
                shape=model.shape._replace(**{name: Shape._field_defaults[name]}),
            )
            for name in model.active
        ]
        found = [refine(problem, option) for option in options]
        better = min(found, key=_cost, default=model)
        if better is model or _needed(problem, model, better):
            return model
        model = better


def _cut(residual: np.ndarray) -> np.ndarray:
    """Return residuals, large ones made smaller."""
    scale = 4 * scale_of(residual)
    return np.clip(residual, -scale, scale) if scale > 0 else residual


def scale_of(residual: np.ndarray) -> float:
    """Return the standard deviation of residuals, whatever the outliers."""
    return float(np.median(np.abs(residual))) / 0.6745


def mean_cost(residual: np.ndarray, scale: float | None = None) -> float:
    """Return the robust mean square: residuals far beyond the scale count as their size."""
    scale = ROBUST * (scale_of(residual) if scale is None else scale)
    if not scale > 1e-9:
        return float((residual**2).mean())
    return float((2 * scale**2 * (np.sqrt(1 + (residual / scale) ** 2) - 1)).mean())


def _lines(problem: Problem, model: Model, rounds: int = 0) -> Model:
    """Return the model with the best gains and offset for its shape.

    Each round takes weight from residuals that are large.
    """
    use = problem.use
    design = np.column_stack([*(x[use] for x in model.parts(problem)), np.ones(use.sum())])
    y = problem.y[use]
    gram = design.T @ design
    gram += 1e-12 * gram.trace() * np.eye(len(gram))
    solution = np.linalg.solve(gram, design.T @ y)
    for _ in range(rounds):
        residual = y - design @ solution
        scale = ROBUST * scale_of(residual)
        if not scale > 1e-9:
            break
        weight = 1 / np.sqrt(1 + (residual / scale) ** 2)
        heavy = design * weight[:, None]
        gram = heavy.T @ design
        gram += 1e-12 * gram.trace() * np.eye(len(gram))
        solution = np.linalg.solve(gram, heavy.T @ y)
    gains = tuple(float(g) for g in solution[1:-1])
    cost = mean_cost(y - design @ solution)
    return replace(
        model, gain=float(solution[0]), offset=float(solution[-1]), gains=gains, cost=cost
    )


def refine(problem: Problem, model: Model) -> Model:
    """Return the model with the best numbers near those that it has."""
    model = _lines(problem, model, 2)
    if not model.active:
        return model
    use = problem.use
    own = problem.u[:, model.driver]
    most = max(float(np.abs(own).max()), 1e-6)
    residual = (problem.y - model.predict(problem))[use]
    scale = max(ROBUST * scale_of(residual), 1e-4)
    limits = {"dead_zone": (0.0, most), "play": (0.0, most), "low": (-most, most)}
    limits |= {"high": (-most, most)} | {name: (0.0, top) for name, top in LARGEST.items()}
    ends = np.array([limits[name] for name in model.active]).T
    wide = np.full(2 + len(model.others), np.inf)
    low, high = np.concatenate([-wide, ends[0]]), np.concatenate([wide, ends[1]])

    def miss(values: np.ndarray) -> np.ndarray:
        return (_with_values(model, values).predict(problem) - problem.y)[use]

    def slope(values: np.ndarray) -> np.ndarray:
        return slopes(problem, _with_values(model, values))[use]

    begin = np.clip(values_of(model), low + 1e-9, high - 1e-9)
    found = least_squares(
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
    better = _lines(problem, _with_values(model, found.x), 2)
    return better if better.cost < model.cost else model


def values_of(model: Model) -> np.ndarray:
    """Return gain, offset, the others' gains, and the active numbers of the shape."""
    shape = [getattr(model.shape, name) for name in model.active]
    return np.array([model.gain, model.offset, *model.gains, *shape])


def _with_values(model: Model, values: np.ndarray) -> Model:
    count = 2 + len(model.others)
    numbers = [float(x) for x in values]
    return replace(
        model,
        gain=numbers[0],
        offset=numbers[1],
        gains=tuple(numbers[2:count]),
        shape=model.shape._replace(**dict(zip(model.active, numbers[count:], strict=True))),
    )


def slopes(problem: Problem, model: Model) -> np.ndarray:
    """Return derivatives of the prediction by :func:`values_of`, ``(N, P)``."""
    parts = model.parts(problem)
    columns = [parts[0], np.ones(len(problem.y)), *parts[1:]]
    here = values_of(model)
    first = len(here) - len(model.active)
    for place, name in enumerate(model.active, first):
        width = STEPS.get(name, 0.01)
        up, down = here.copy(), here.copy()
        up[place] += width
        down[place] -= width
        if name not in ("low", "high"):
            down[place] = max(down[place], 0.0)
        if name == "keep":
            up[place] = min(up[place], 0.995)
        ends = [_with_values(model, x).predict(problem) for x in (up, down)]
        columns.append((ends[0] - ends[1]) / (up[place] - down[place]))
    return np.column_stack(columns)


def interval_widths(problem: Problem, model: Model) -> np.ndarray:
    """Return half widths of the 95 % intervals of :func:`values_of`, ``(P,)``.

    The uncertainty of a delay that was found to be none counts, too.
    """
    count = len(values_of(model))
    if not {"delay", "keep"} & set(model.active):
        model = replace(model, active=(*model.active, "delay"))
    use = problem.use
    columns = slopes(problem, model)[use]
    residual = (problem.y - model.predict(problem))[use]
    scale = ROBUST * scale_of(residual)
    share = (residual / max(scale, 1e-9)) ** 2
    pull = residual / np.sqrt(1 + share)
    stiff = ((1 + share) ** -1.5).mean()
    gram = columns.T @ columns * stiff
    size = np.sqrt(np.maximum(gram.diagonal(), 1e-100))
    unit = gram / np.outer(size, size)
    values, vectors = np.linalg.eigh(unit)
    values = np.maximum(values, 1e-10)
    inverse = (vectors / values) @ vectors.T / size
    freedom = math.sqrt(len(residual) / max(len(residual) - len(size), 1))
    widths = half_widths((columns / size * pull[:, None]) @ inverse) * freedom
    return CHOSEN * widths[:count]
