"""The usual mistakes in a dynamics model, and what it would predict without them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from afm_rl.diagnosis.frames import other_frames, some_of, subsets
from afm_rl.diagnosis.simulations import other_simulations
from afm_rl.diagnosis.suspect import ages, history
from afm_rl.diagnosis.words import UNITS
from afm_rl.dynamics import DynamicsModel, MuJoCoDynamics
from afm_rl.spaces.manifold import wrap_angle

NEAR = 0.1  # a factor this near to 1 is none


class Transitions(NamedTuple):
    """N transitions of a model's robot; rows that are not known are NaN."""

    model: DynamicsModel
    state: Tensor
    action: Tensor
    after: Tensor
    before: Tensor
    """The states a step earlier."""
    last: Tensor
    """The actions a step earlier."""
    sent: Sequence[tuple[str, Tensor]]
    """The actions that may have acted instead, and what the robot does then."""

    @classmethod
    def of(cls, model: DynamicsModel, state: Tensor, action: Tensor, after: Tensor) -> Transitions:
        """Return transitions in the order of time, of which some follow each other."""
        row, age = torch.arange(len(action)), ages(state, after)
        late, before = history(state, action, after, 8), history(state, state, after, 1)[:, 1]
        sent = [(f"acts {k} step{'s' * (k > 1)} late", late[:, k]) for k in range(1, 9)]
        following = action.roll(-1, 0).where((age.roll(-1) > 0).unsqueeze(-1), torch.nan)
        sent.append(("acts on the next row's action", following))
        for count in (2, 3, 4):
            said = f"holds each action for {count} steps (a loop at another rate)"
            sent.append((said, late[row, age % count]))
        return cls(model, state, action, after, before, late[:, 1], sent)

    def part(self, most: int) -> Transitions:
        """Return at most so many rows, evenly spread."""
        at = torch.linspace(0, len(self.state) - 1, min(most, len(self.state))).long()
        state, action, after, before, last = (x[at] for x in self[1:6])
        sent = [(said, x[at]) for said, x in self.sent]
        return Transitions(self.model, state, action, after, before, last, sent)

    def motion(self, scale: Any = 1.0, offset: Any = 0.0) -> Tensor:
        """Return how the states change, ``(N, D)``; of other units and zeros, in the own unit."""
        here, there = (scale * x + offset for x in (self.state, self.after))
        return self.model.manifold.difference(there, here) / scale

    def step(
        self,
        gain: Any = 1.0,
        scale: Any = 1.0,
        offset: Any = 0.0,
        late: Tensor | None = None,
        bias: Any = 0.0,
    ) -> Tensor:
        """Return what the model predicts of that, of ``gain * action + bias``, or late, too."""
        here, action = scale * self.state + offset, self.action
        if late is not None:
            action = action + late * (self.last - action)
        there = self.model(here, gain * action + bias)
        return self.model.manifold.difference(there, here) / scale

    def missed(self, scale: Any = 1.0, offset: Any = 0.0, **units: Any) -> Tensor:
        """Return what the model misses, ``(N, D)``."""
        return self.motion(scale, offset) - self.step(scale=scale, offset=offset, **units)

    def miss(self) -> Tensor:
        """Return what the model misses, all of it where it predicts no numbers, ``(N, D)``."""
        missed = self.missed()
        return torch.where(missed.isfinite(), missed, self.motion())


class Mistake(NamedTuple):
    """What the robot does instead, and what the model misses once that is put right."""

    cause: str
    miss: Tensor
    factor: Sequence[float] = ()
    fitted: int = 0
    """Numbers that were fitted for it."""
    offset: Sequence[float] = ()
    """Of a map of actions, beside its factors."""


def usual_mistakes(
    seen: Transitions, miss: Tensor, size: Tensor, names: Sequence[str], actuators: Sequence[str]
) -> Iterator[Mistake]:
    """Yield the usual mistakes, the simplest first.

    Args:
        seen: N transitions.
        miss: what the model misses of them, ``(N, D)``.
        size: of the motion, ``(D,)``.
        names: of the D entries of the state's tangent.
        actuators: names of the A actions.
    """
    model, state, action, after, _, last, sent = seen
    between, states, axes = model.manifold.difference, model.state_size, model.action_size
    motion, step = seen.motion(), seen.step()
    flat = states == len(size)  # no rotations
    jumps = (miss.abs().amax(0) > math.pi) & (miss.abs().median(0).values < 1)
    if flat and bool(jumps.any()):
        which = jumps.nonzero().flatten().tolist()
        turning = some_of([names[k] for k in which])
        cause = f"turns through pi in {turning} (Manifold({states}, angles={which}))"
        yield Mistake(cause, torch.where(jumps, wrap_angle(miss), miss))
    if isinstance(model, MuJoCoDynamics):
        yield from _range_of_controls(seen, actuators)
    for cause, earlier in sent:
        yield Mistake(cause, between(after, model(state, earlier)))
    many = [1.0, -1.0, 0.01, 0.1, 10.0, 100.0, *UNITS.values()]
    begin = many[:1] if model.stiff else many  # what is far off may be more than a simulator bears
    (gain,), residual = _fit(seen, size, [[k] for k in begin], lambda x: {"gain": x})
    if abs(gain - 1) > NEAR:
        yield Mistake(f"acts on {gain:.3g} times the action ({_unit(gain)})", residual, (gain,), 1)
    pace = _ratio(motion, step)
    if abs(pace - 1) > NEAR:
        cause = f"moves {pace:.3g} times as far in a step (dt)"
        yield Mistake(cause, motion - pace * step, (pace,), 1)
    there = model(state, action)
    for n in range(2, 21):
        there = model(there, action)
        cause = f"makes {n} steps of the model in one (dt, frame_skip)"
        yield Mistake(cause, between(after, there), (n,), 1)
    if isinstance(model, MuJoCoDynamics):
        for cause, there in other_simulations(model, state, last, action):
            yield Mistake(cause, between(after, there), (), 1)
    else:
        yield from _late_in_a_step(seen, size)
    cause = "feels other forces that depend on its state (gravity, damping, stiffness)"
    residual, fitted = _without_forces(seen, miss)
    yield Mistake(cause, residual, (), fitted)
    if axes > 1:
        gains, _, residual = _map_of_actions(seen, size, gain, biased=False)
        pairs = zip(gains, actuators, strict=True)
        each = some_of([f"{k:.3g} times {name}" for k, name in pairs if abs(k - 1) > NEAR])
        yield Mistake(f"acts on {each or 'all'} (signs, gains or units)", residual, gains, axes)
    gains, biases, residual = _map_of_actions(seen, size, gain, biased=True)
    yield Mistake(_affine(gains, biases, actuators), residual, gains, 2 * axes, biases)
    for cause, read in other_frames(model, names):
        other = seen._replace(state=read(state), after=read(after))
        yield Mistake(cause, other.missed(), (), 1)
    if flat:
        yield from _other_units(seen, size, names)


def _range_of_controls(seen: Transitions, actuators: Sequence[str]) -> Iterator[Mistake]:
    """Yield actions of -1 to 1 that span the range of the controls."""
    low, high = (
        getattr(seen.model, name).to(seen.action) for name in ("action_low", "action_high")
    )
    gain, bias = (high - low) / 2, (high + low) / 2
    if bool(gain.isfinite().all()) and not bool(((gain - 1).abs() + bias.abs() < 1e-6).all()):
        numbers = gain.tolist(), bias.tolist()
        cause = f"{_affine(*numbers, actuators)}, the range of the controls (action_map='range')"
        yield Mistake(cause, seen.missed(gain=gain, bias=bias), numbers[0], 0, numbers[1])


def _affine(gain: Sequence[float], bias: Sequence[float], actuators: Sequence[str]) -> str:
    """Return a map of actions in words.

    >>> _affine([1.0, 0.5], [0.5, 0.0], ["a", "b"])
    'acts on k u + b of each action u: 1 a + 0.5, 0.5 b + 0'
    """
    numbers = zip(gain, actuators, bias, strict=True)
    each = [f"{k:.3g} {name} {'-' if b < 0 else '+'} {abs(b):.3g}" for k, name, b in numbers]
    return f"acts on k u + b of each action u: {some_of(each)}"


def _late_in_a_step(seen: Transitions, size: Tensor) -> Iterator[Mistake]:
    """Yield commands that act a fraction of a step late."""
    (late,), residual = _fit(seen, size, [[0.5]], lambda x: {"late": x})
    if NEAR < late < 1 - NEAR:
        cause = f"acts {late:.2g} steps late, or interpolates between commands"
        yield Mistake(cause, residual, (late,), 1)


def _other_units(seen: Transitions, size: Tensor, names: Sequence[str]) -> Iterator[Mistake]:
    """Yield mistakes in the units of the state's entries, in the motion and in forces only."""
    count, motion, stiff = len(size), seen.motion(), seen.model.stiff
    # Of a small state all combinations are tried.
    lengths = [count] if stiff else [1, count] if count > 6 else range(1, count + 1)
    angles = [
        (math.pi / 180, "degrees, the model in radians"),
        (180 / math.pi, "radians, not in degrees"),
    ]
    for unit, words in angles[: 1 if stiff else 2]:  # simulators have radians
        step = seen.step(unit, unit)
        yield Mistake(f"has states and actions in {words}", motion - step, [unit], 1)
        for chosen, which in subsets(names, lengths):
            scale = torch.where(which, unit, 1.0).to(size)
            step, cause = seen.step(scale=scale), f"has {chosen} in {words}"
            yield Mistake(cause, motion - step, scale.tolist(), 1)
            yield Mistake(cause, motion - scale * step, scale.tolist(), 1)
    if stiff:
        return
    scales = (1.0, 0.3, 0.1, 0.02, 10.0)
    starts = [[math.log(k)] * count + [0.01] * count for k in scales]
    numbers, residual = _fit(
        seen, size, starts, lambda x: {"scale": x[:count].exp(), "offset": x[count:]}, len(scales)
    )
    factor = [math.exp(x) for x in numbers[:count]]
    pairs = zip(factor, names, numbers[count:], strict=True)
    each = some_of([f"{k:.3g} {name} {round(b, 4) + 0.0:+.3g}" for k, name, b in pairs])
    near = all(abs(k - 1) < NEAR for k in factor)
    reason = "another zero, the sign of gravity" if near else "normalised observations, units"
    cause = f"has states that the model knows as {each} ({reason})"
    yield Mistake(cause, residual, factor, 2 * count)


def _fit(
    seen: Transitions,
    size: Tensor,
    starts: Sequence[Sequence[float]],
    units: Callable[[Tensor], Mapping[str, Any]],
    tries: int = 2,
) -> tuple[list[float], Tensor]:
    """Return the numbers with which the model misses least, and what it misses then.

    Args:
        seen: N transitions.
        size: of the motion, ``(D,)``.
        starts: of the search; it begins at the best of them.
        units: makes arguments of :meth:`Transitions.step` of the numbers.
        tries: how many of the starts are searched from.
    """

    def left(x: Any) -> Tensor:
        return seen.missed(**units(torch.as_tensor(x).to(size)))

    def residual(x: Any) -> np.ndarray:
        return (left(x) / size).nan_to_num(1e3, 1e3, -1e3).double().cpu().numpy().ravel()

    def slope(x: np.ndarray) -> np.ndarray:  # in single precision, SciPy's steps are too small
        steps = np.diag(np.maximum(3e-3 * np.abs(x), 1e-4))
        return np.stack([(residual(x + h) - residual(x - h)) / (2 * h.sum()) for h in steps], -1)

    if len(starts) > tries:
        starts = sorted(starts, key=lambda x: np.abs(residual(x)).mean())[:tries]
    rule = {"loss": "soft_l1", "max_nfev": 30, "ftol": 1e-4, "xtol": 1e-4}
    fits = [least_squares(residual, x, slope, **rule) for x in starts]
    best = min(fits, key=lambda fit: fit.cost).x.tolist()
    return best, left(best)


def _map_of_actions(
    seen: Transitions, size: Tensor, gain: float, biased: bool
) -> tuple[list[float], list[float], Tensor]:
    """Return gains and biases of the actions with which the model misses least, and the errors.

    The search begins with gains of 1 and of ``gain``.
    """
    axes = seen.action.shape[-1]
    starts = [[k] * axes + [0.0] * axes * biased for k in (1.0, gain)]
    numbers, residual = _fit(
        seen, size, starts, lambda x: {"gain": x[:axes], "bias": x[axes:] if biased else 0.0}
    )
    return numbers[:axes], numbers[axes:], residual


def _ratio(of: Tensor, to: Tensor) -> float:
    """Return k of ``of = k to`` ``(N, D)``, the median of all, each D being worth the same.

    >>> _ratio(torch.tensor([[2.0], [4.0], [9.0]]), torch.tensor([[1.0], [2.0], [-0.1]]))
    2.0
    """
    ratio, order = (of / to).flatten().sort()
    weight = (to.abs() / to.abs().mean(0)).nan_to_num(0.0).flatten()[order]
    half = weight.cumsum(0) >= 0.5 * weight[ratio.isfinite()].sum()
    return float(ratio[half.int().argmax()])


def _without_forces(seen: Transitions, miss: Tensor) -> tuple[Tensor, int]:
    """Return the error without linear effects of the state and of its own motion.

    And how many numbers these lines have, of entries of which they explain more than half. The
    state is that of a step earlier: else what is missed of a noisy one would seem to depend on it.
    """
    model, before = seen.model, seen.before
    free = model.manifold.difference(model(before, torch.zeros_like(seen.action)), before)
    known, remaining, fitted = free.isfinite().all(-1), torch.full_like(miss, torch.nan), 0
    for j, own in enumerate(miss[known].double().cpu().T):
        rows = torch.cat([torch.ones_like(free[:, :1]), before, free[:, j : j + 1]], -1)[known]
        rows = rows.double().cpu()
        rows = rows / rows.square().mean(0).sqrt().clamp_min(1e-9)
        line = torch.linalg.lstsq(rows, own.unsqueeze(-1), driver="gelsd").solution
        rest = own - (rows @ line).squeeze(-1)
        explains = bool(rest.abs().mean() < 0.5 * own.abs().mean())
        remaining[known, j] = (rest if explains else own).to(remaining)
        fitted += rows.shape[-1] * explains
    return remaining, fitted


def _unit(gain: float) -> str:
    """Return what a gain may come from.

    >>> _unit(-1.0), _unit(57.3), _unit(0.5)
    ('a sign', 'degrees for radians', 'a gain or a unit')
    """
    units = [name for name, k in UNITS.items() if abs(abs(gain) / k - 1) < NEAR]
    return "a sign" if 0.7 < -gain < 1.4 else units[0] if units else "a gain or a unit"
