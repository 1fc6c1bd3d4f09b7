"""Actuators of one kind, such as left and right wheels, are explained by the same numbers."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

from afm_rl.diagnosis.changes import Part, problem_of
from afm_rl.diagnosis.fit import FLOOR
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.model import Model, Problem, refine
from afm_rl.diagnosis.settings import Settings

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


def agree(
    log: Log, found: Mapping[int, Sequence[Part]], settings: Settings
) -> dict[int, Sequence[Part]]:
    """Return the parts of all actuators, those of one kind with the same numbers.

    Of the sets of numbers that the members were found to need, the one that is best for all of them
    together (BIC) is fitted to each. Members that changed, or follow another command, stay.

    Args:
        log: scaled.
        found: parts of each actuator.
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
        options = []
        for other in members:
            pattern = found[other][0].model
            models = {j: _like(problems[j], found[j][0].model, pattern) for j in members}
            score = sum(
                len(problems[j].y) * found[j][0].weight * math.log(model.cost + FLOOR)
                + settings.penalty * model.size
                for j, model in models.items()
            )
            options.append((score, other, models))
        _, _, models = min(options, key=lambda option: option[:2])
        better |= {j: [replace(found[j][0], model=model)] for j, model in models.items()}
    return better


def _like(problem: Problem, own: Model, pattern: Model) -> Model:
    """Return a model with the numbers that another one needs."""
    if own.active == pattern.active:
        return refine(problem, own)
    kept = {name: getattr(own.shape, name) for name in own.active if name in pattern.active}
    shapes = (pattern.shape, pattern.shape._replace(**kept))
    return min(
        (refine(problem, replace(own, active=pattern.active, shape=shape)) for shape in shapes),
        key=lambda model: model.cost,
    )
