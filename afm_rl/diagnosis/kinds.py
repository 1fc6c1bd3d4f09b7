"""Actuators of one kind, such as left and right wheels, are explained by the same numbers."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from afm_rl.diagnosis.changes import Part, problem_of
from afm_rl.diagnosis.fit import FLOOR
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.model import Model, Problem, refine
from afm_rl.diagnosis.settings import Settings

WEAK = {"delay": 0.1, "keep": 0.05, "rate": 2.0, "dead_zone": 0.01, "play": 0.01, "cut": 1.0}
WEAK |= {"low": -1.0, "high": 1.0}
"""Numbers with which next to nothing happens, in half ranges and steps."""
SIDES = set("left right front rear back fl fr rl rr bl br lf rf lh rh lr l r f b".split())


def kind_of(name: str) -> str:
    """Return what is left of a name without sides and numbers.

    >>> kind_of("kLeftShoulderPitch"), kind_of("wheel_fl_2"), kind_of("left"), kind_of("b")
    ('k shoulder pitch', 'wheel', '', 'b')
    """
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    if len(name) < 2:
        return name
    return " ".join(word.lower() for word in words if word.lower() not in SIDES)


def small_twins(names: Sequence[str], ranges: np.ndarray, small: float = 1 / 3) -> dict[int, str]:
    """Return the actuators that move far less than their twin on the other side, and what to say.

    >>> small_twins(["left_elbow", "right_elbow", "head"], np.array([0.1, 1.0, 0.2]))
    {0: 'it moves by 10 % of what right_elbow does, and friction looks like a fault; move it more'}
    """
    kinds = defaultdict(list)
    for j, name in enumerate(names):
        kinds[kind_of(name)].append(j)
    found = {}
    for one, other in (pair for pair in kinds.values() if len(pair) == 2):
        low, high = sorted((one, other), key=lambda j: ranges[j])
        if 0 < ranges[low] < small * ranges[high]:
            found[low] = (
                f"it moves by {100 * ranges[low] / ranges[high]:.0f} % of what {names[high]} does, "
                "and friction looks like a fault; move it more"
            )
    return found


def agree(
    log: Log, found: Mapping[int, Sequence[Part]], reach: np.ndarray, settings: Settings
) -> dict[int, Sequence[Part]]:
    """Return the parts of all actuators, those of one kind with the same numbers.

    Of the sets of numbers that the members were found to need, the one that is best for all of them
    together (BIC) is fitted to each. Members that changed, or follow another command, stay.

    Args:
        log: scaled.
        found: parts of each actuator.
        reach: half range of each command, ``(A,)``.
        settings: how many rows are looked at, and what a number costs.
    """
    kinds = defaultdict(list)
    for j, parts in found.items():
        if len(parts) == 1 and parts[0].model.driver == j:
            kinds[kind_of(log.names[j])].append(j)
    better = dict(found)
    for members in kinds.values():
        if len({found[j][0].model.active for j in members}) < 2:
            continue
        some = log.thinned(settings.refined)
        problems = {j: problem_of(some, j, found[j][0].lead, settings) for j in members}
        rows = {j: len(problem.y) * found[j][0].weight for j, problem in problems.items()}
        options = []
        for other in members:
            pattern = found[other][0].model
            models = {j: _like(problems[j], found[j][0].model, pattern) for j in members}
            score = sum(
                rows[j] * math.log(model.cost + FLOOR) + settings.price(rows[j]) * model.size
                for j, model in models.items()
            )
            options.append((score, other, models))
        _, _, models = min(options, key=lambda option: option[:2])
        rates = [models[j].shape.rate * reach[j] for j in members]
        if max(rates) > 2 * min(rates):  # a limit that another one exceeds is none
            models = {j: _without_rate(problems[j], model) for j, model in models.items()}
        better |= {j: [replace(found[j][0], model=model)] for j, model in models.items()}
    return better


def _without_rate(problem: Problem, model: Model) -> Model:
    """Return a model whose rate limit is a lag instead."""
    kept = tuple(name for name in model.active if name != "rate")
    shape = model.shape._replace(rate=math.inf, keep=model.shape.keep or 0.5)
    return refine(problem, replace(model, active=tuple({*kept, "keep"}), shape=shape))


def _like(problem: Problem, own: Model, pattern: Model) -> Model:
    """Return a model with the numbers that another one needs."""
    if own.active == pattern.active:
        return refine(problem, own)
    kept = {name: getattr(own.shape, name) for name in own.active if name in pattern.active}
    weak = {name: WEAK[name] for name in pattern.active if name in WEAK}
    shapes = (pattern.shape, pattern.shape._replace(**kept), pattern.shape._replace(**weak | kept))
    return min(
        (refine(problem, replace(own, active=pattern.active, shape=shape)) for shape in shapes),
        key=lambda model: model.cost,
    )
