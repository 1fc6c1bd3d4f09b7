"""Does a dynamics model predict how a robot moves, and what is wrong with it if not?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from afm_rl.diagnosis.frames import some_of
from afm_rl.diagnosis.log import FEWEST
from afm_rl.diagnosis.mistakes import Transitions, usual_mistakes
from afm_rl.diagnosis.suspect import PART, FaultTable, suspect
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError
from afm_rl.learning.residual_fit import relevant_coordinates, residual_parts

GOOD = 0.9  # share of the motion that a right model predicts
EXACT = 0.99  # the share that a model without any mistake predicts
FEW = 300  # transitions that are looked at where a cause is searched
FITTED, TRIED = 100, 6000  # steps of a residual; predictions to look for faults, about
SURE = 10.0  # nats that a cause has to gain, and each number that is fitted for it


@dataclass(frozen=True)
class ModelCheck:
    """What a model predicts of a robot's motion, and the likely cause of what it does not.

    Args:
        names: of the entries of the state; of a rotation, of its tangent vector.
        predicted: share of each entry's motion that the model predicts, 0 to 1: one less the mean
            absolute error of its steps over their mean absolute size. NaN where nothing moves.
        steps: transitions that were looked at.
        cause: what the robot does instead, in words; empty where nothing fits.
        factor: k of the cause: one number, or one for each action or entry of the state.
        offset: b of the cause ``k u + b``, one number for each action; empty for other causes.
        corrected: share that the model predicts with that put right, the mean over what moves.
        explained: share of the squared misses that a residual fitted to 100 of the steps explains,
            the mean over coordinates.
        fault: which fault of the actuators the steps look like, in words; empty if none.
        noise: stated and measured standard deviation of each entry.

    >>> print(ModelCheck(("angle", "speed"), (1.0, 0.4), 300, "acts a step late", (1,), 1.0))
    The model predicts only 70 % of the motion (speed 40 %, angle 100 %; 300 steps).
    Likely cause: the robot acts a step late. With that put right: 100 %.
    """

    names: tuple[str, ...]
    predicted: tuple[float, ...]
    steps: int
    cause: str = ""
    factor: tuple[float, ...] = ()
    corrected: float = math.nan
    offset: tuple[float, ...] = ()
    explained: float = math.nan
    fault: str = ""
    noise: tuple[tuple[float, float], ...] = ()

    @property
    def action_map(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Gains and offsets by which the environment makes controls of actions, if that is it."""
        return (self.factor, self.offset) if self.offset else None

    @property
    def share(self) -> float:
        """Share of the motion that the model predicts, 0 to 1: the mean over what moves."""
        return float(np.nanmean(self.predicted))

    @property
    def right(self) -> bool:
        """Is the model right, as far as this motion shows it?"""
        fair = float(np.nanmin(self.predicted)) >= 0.5
        return not self.cause and self.share >= GOOD and fair

    def __str__(self) -> str:
        pairs = sorted(zip(self.predicted, self.names, strict=True))
        each = some_of([f"{name} {100 * x:.0f} %" for x, name in pairs if not math.isnan(x)], 8)
        begin = "The model is right: it predicts" if self.right else "The model predicts only"
        text = f"{begin} {100 * self.share:.0f} % of the motion ({each}; {self.steps} steps)."
        if self.cause:
            kind = "Likely" if self.corrected >= GOOD else "Nearest"
            text += f"\n{kind} cause: the robot {self.cause}. With that put right: "
            text += f"{100 * self.corrected:.0f} %."
        elif not self.right:
            text += "\nNo usual mistake explains the rest: noise, or physics that the model lacks."
        if self.fault:
            text += f"\nThese steps look like a fault: {self.fault}."
        if self.explained > 0:
            text += f"\n{FITTED} of these steps would explain {100 * self.explained:.0f} % of what "
            text += "it misses (fit_residual)."
        low = [
            f"{name} {stated:.2g}, measured {measured:.2g}"
            for name, (stated, measured) in zip(self.names, self.noise, strict=False)
            if measured > 2 * stated
        ]
        if low:
            text += f"\nThe noise that it states is too low: {some_of(low)}."
        return text


@torch.no_grad()
def check_transitions(
    model: DynamicsModel,
    states: Any,
    actions: Any,
    next_states: Any,
    names: Sequence[str] = (),
    actuators: Sequence[str] = (),
) -> ModelCheck:
    r"""Compare the steps of a robot with those that a model predicts.

    Where they differ, each usual mistake is put right in turn, and the likeliest is named: the one
    with the largest

    .. math:: N \sum_i \log \left(\overline{|e_i|} \,/\, \overline{|e_i'|}\right) - 10\,p

    (a Laplace likelihood), if that is above 10 and the model predicts clearly more: e and e' are
    what it misses of N steps without and with that put right, for which p numbers are fitted.

    Args:
        model: f.
        states: ``(N, S)``, in the order of time: a row that begins where the one before it ends
            comes after it.
        actions: that were executed, ``(N, A)``.
        next_states: ``(N, S)``.
        names: of the S entries of the state; those that the model has, or numbers, if none.
        actuators: names of the A actions, likewise.

    Raises:
        ConfigurationError: for shapes that do not fit, few steps, or a robot that rests.

    >>> from afm_rl.dynamics import Dubins
    >>> s, a = torch.zeros(50, 3), torch.linspace(-1, 1, 100).sin().reshape(50, 2)
    >>> found = check_transitions(Dubins(), s, a, Dubins()(s, -a))
    >>> found.share, found.cause, found.corrected
    (0.0, 'acts on -1 times the action (a sign)', 1.0)
    """
    dtype = torch.float64 if model.stiff else torch.get_default_dtype()
    given = [torch.as_tensor(x).to(dtype) for x in (states, actions, next_states)]
    rows, sizes = len(given[0]), (model.state_size, model.action_size, model.state_size)
    if rows < FEWEST or [x.shape for x in given] != [(rows, size) for size in sizes]:
        raise ConfigurationError(
            f"check_model: states, actions, next states {[tuple(x.shape) for x in given]}: "
            f"expected {FEWEST} rows or more, of {sizes} numbers"
        )
    finite = torch.cat(given, -1).isfinite().all(-1)
    seen = Transitions.of(model, *(x[finite] for x in given)).part(4000)
    size, miss = seen.motion().abs().mean(0), seen.miss()
    largest = seen.state.abs().amax() + size.amax()
    # What is missed below a thousandth of the motion is all the same.
    floor = torch.maximum(1e-3 * size, 8 * torch.finfo(dtype).eps * largest)

    predicted = _shares(miss, size, floor)
    if bool(predicted.isnan().all()):
        raise ConfigurationError(
            f"check_model: the robot does not move in {rows} steps; make it move"
        )
    own = getattr(model, "names", ((), ()))
    turned = getattr(model.manifold, "quaternions", ())  # one entry less in the tangent
    names = [name for k, name in enumerate(names or own[0]) if k not in turned]
    if len(names) != len(size):
        names = [f"state[{k}]" for k in range(len(size))]
    actuators = actuators or own[1] or [f"action[{k}]" for k in range(model.action_size)]
    check = ModelCheck(tuple(names), tuple(predicted.tolist()), len(miss))
    if bool((predicted.nan_to_num(1.0) > EXACT).all()):
        return check
    few = seen.part(FEW // 3 if model.stiff else FEW)  # simulators take their time
    check = _with_cause(check, few, size, floor, actuators)
    if check.cause and check.corrected >= GOOD:
        return check  # which is put right first
    return _with_residual(check, model, [x[finite] for x in given], actuators)


def _shares(miss: Tensor, size: Tensor, floor: Tensor) -> Tensor:
    """Return the share of each entry's motion ``(D,)`` that is predicted; NaN where none moves."""
    error = miss.abs().mean(0)
    total = torch.maximum(size, error)
    return torch.where(total > floor, 1 - error / total, torch.nan)


def _with_cause(
    check: ModelCheck, seen: Transitions, size: Tensor, floor: Tensor, actuators: Sequence[str]
) -> ModelCheck:
    """Return the check with the likeliest of the usual mistakes, if one is likely."""
    most, miss, model = SURE, seen.miss(), seen.model
    for mistake in usual_mistakes(seen, miss, size + floor, check.names, actuators):
        known = mistake.miss.isfinite().all(-1)
        old, new = miss[known], mistake.miss[known]
        gained = ((old.abs().mean(0) + floor) / (new.abs().mean(0) + floor)).log()
        nats = len(miss) * float(gained.sum()) - SURE * mistake.fitted
        before, after = (_shares(each, size, floor) for each in (old, new))
        # It has to gain a tenth of the motion, if it does not halve what is missed; and lose none.
        clear = (after - before > 0.1) | (after > before) & (gained > math.log(2))
        clear &= ~(before - after > 0.1).any()
        if mistake.fitted > model.action_size:  # so many numbers would refine any model
            clear &= (before < GOOD) & (after.nanmean() >= GOOD)
        if known.sum() >= FEWEST and nats > most and bool(clear.any()):
            most, corrected = nats, float(after.nanmean())
            factor, offset = tuple(mistake.factor), tuple(mistake.offset)
            check = replace(check, cause=mistake.cause, factor=factor, offset=offset)
            check = replace(check, corrected=corrected)
            if corrected > EXACT:
                break
    return check


def _with_residual(
    check: ModelCheck, model: DynamicsModel, rows: Sequence[Tensor], actuators: Sequence[str]
) -> ModelCheck:
    """Return the check with what a residual would explain, and the fault that steps look like."""
    faults = len(FaultTable.of(torch.ones(model.action_size)).words)
    state, action, after = rows
    fault = suspect(model, state, action, after, actuators, most=max(PART, TRIED // faults))
    state, action, after = (x[:FITTED] for x in rows)
    probed = slice(None, None, max(1, len(state) // 20))
    relevant = relevant_coordinates(model, state[probed], action[probed])
    predicted = model(state, action)
    known = predicted.isfinite().all(-1)
    if known.sum() < FEWEST:
        return replace(check, fault=fault)
    fit = residual_parts(model.manifold, state[known], predicted[known], after[known], relevant)
    stated = model.noise_scale(state[known], action[known]).mean(0)
    return replace(
        check,
        fault=fault,
        explained=float(fit["explained"].mean()),
        noise=tuple(zip(stated.tolist(), fit["noise"].tolist(), strict=True)),
    )
