"""Intervals over all explanations that are about as good."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.changes import Part
from afm_rl.diagnosis.fit import FLOOR, larger
from afm_rl.diagnosis.model import Model, Problem, interval_widths, refine, values_of, weight_of
from afm_rl.diagnosis.settings import Settings


def likely_intervals(
    problem: Problem, model: Model, part: Part, centre: float, settings: Settings
) -> np.ndarray:
    """Return the 95 % intervals of the gain, of a response, and of the time it takes.

    ``(3, 2)``, the time is delay and lag together, in steps.

    They span those of every mixture of delay and lag that explains the response about as well, and
    of a model with one number more that explains it a little better: what was left out because it
    is not sure may still be there.

    Args:
        problem: response and commands.
        model: the explanation that was chosen.
        part: where it was found.
        centre: the command, in its half ranges.
        settings: which models are tried.
    """
    rows = problem.use.sum() * weight_of(problem, model)
    ends = []
    for found in [model, *_others(problem, model, settings)]:
        lost = rows * math.log((found.cost + FLOOR) / (model.cost + FLOOR))
        if lost < 4.0 - 6.0 * max(found.size - max(model.size, 1), 0):
            gain, offset = values_of(found)[:2]
            late = max(found.shape.delay, 0.0)
            if found.shape.keep > 1e-6:
                late -= 1 / math.log(found.shape.keep)
            middle = np.array([gain, offset + centre * gain, late])
            widths = interval_widths(problem, found, centre)
            ends.append([middle - widths, middle + widths])
    lows, highs = np.moveaxis(np.array(ends), 1, 0)
    return np.stack([lows.min(0), highs.max(0)], -1)


def _others(problem: Problem, model: Model, settings: Settings) -> list[Model]:
    """Return other explanations: one number more, or another mixture of delay and lag."""
    if len(problem.y) <= settings.fitted:
        found = list(larger(problem, model))
    else:
        found = []
    late = model.shape.delay
    if model.shape.keep > 0:
        late -= 1 / math.log(model.shape.keep)
    rest = tuple(name for name in model.active if name not in ("delay", "keep"))
    if len(problem.y) <= settings.fitted:
        for names, delay, lag in (
            (("delay",), late, 0.0),
            (("keep",), 0.0, max(late, 0.3)),
            (("delay", "keep"), late / 2, max(late, 0.3) / 2),
        ):
            keep = math.exp(-1 / lag) if lag else 0.0
            shape = model.shape._replace(delay=delay, keep=keep)
            found.append(replace(model, active=(*rest, *names), shape=shape))
    return [refine(problem, other) for other in found]
