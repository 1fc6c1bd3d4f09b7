"""A model of a response, and the best gains for it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from afm_rl.diagnosis.intervals import independence
from afm_rl.diagnosis.lines import ridge
from afm_rl.diagnosis.log import Clock
from afm_rl.diagnosis.response import Shape, lagging, respond, shaped, stacked
from afm_rl.diagnosis.settings import Settings

DOWN, GAIN_DRIFT, OFFSET_DRIFT = -1, -2, -3
"""Among the others: the response of negative commands, that times the time, and the time."""
FLOOR = 1e-5  # share of the variance: better fits are all the same
BATCH = 300_000  # numbers that are computed at once, at most


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

    def parts(self, problem: Problem, shape: Any = None) -> list[np.ndarray]:
        """Return the responses at gain 1 to the driver and to the others, ``(N,)`` each.

        With M other shapes at once, ``(N, M)``.
        """
        shape = self.shape if shape is None else shape
        clock, keep, linear = problem.clock, shape.keep, shape.linear
        before = shaped(clock, problem.u[:, self.driver], shape, problem.begin)
        own = lagging(clock, before, keep)
        time = np.broadcast_to(problem.time, own.T.shape).T
        odd = {
            DOWN: lambda: lagging(clock, np.minimum(before, 0.0), keep),
            GAIN_DRIFT: lambda: own * time,
            OFFSET_DRIFT: lambda: time,
        }
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


def scale_of(residual: np.ndarray) -> np.ndarray:
    """Return the standard deviations of residuals ``(*B, N)``, whatever a tenth of them is.

    By their 85 % quantile: the median would take every transient of a step for an outlier.
    """
    place = 0.85 * (residual.shape[-1] - 1)  # np.quantile takes three times as long
    low, high = int(place), math.ceil(place)
    ranked = np.partition(np.abs(residual), (low, high), axis=-1)
    return (ranked[..., low] + (place - low) * (ranked[..., high] - ranked[..., low])) / 1.4395


def costs(residual: np.ndarray, scale: np.ndarray | None = None) -> np.ndarray:
    """Return the squares of residuals ``(*B, N)``, rather their sizes far beyond the scale."""
    scale = scale_of(residual) if scale is None else scale
    scale = 2.0 * np.maximum(scale, math.sqrt(FLOOR))[..., None]
    return 2 * residual**2 / (np.sqrt(1 + (residual / scale) ** 2) + 1)


def fit_lines(problem: Problem, models: Sequence[Model], rounds: int = 0) -> list[Model]:
    """Return models with the best gains and offset for their shapes; all follow the same commands.

    Each round takes weight from residuals that are large. All models are fitted at once, as long
    as their responses are ``BATCH`` numbers or less.
    """
    size = max(BATCH // len(problem.y), 1)
    if len(models) > size:
        groups = (models[k : k + size] for k in range(0, len(models), size))
        return [model for group in groups for model in fit_lines(problem, group, rounds)]
    parts = models[0].parts(problem, stacked([model.shape for model in models]))
    design = np.stack([*parts, np.ones_like(parts[0])], -1)[problem.use].swapaxes(0, 1)
    y, heavy = problem.y[problem.use], design
    for later in reversed(range(rounds + 1)):
        gram = heavy.mT @ design
        gram[:, -1, -1] += problem.at_rest
        solution = ridge(gram, (heavy.mT @ y)[..., None], 1e-12)
        residual = y - (design @ solution)[..., 0]
        if later:
            scale = 2.0 * np.maximum(scale_of(residual), 1e-9)[:, None]
            heavy = design / np.sqrt(1 + (residual / scale) ** 2)[..., None]
    means = costs(residual).mean(-1).tolist()
    return [
        replace(model, gain=gain, offset=offset, gains=tuple(gains), cost=cost)
        for model, (gain, *gains, offset), cost in zip(
            models, solution[..., 0].tolist(), means, strict=True
        )
    ]
