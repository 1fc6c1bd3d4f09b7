"""What actuators have in common: their kind, the unit of their responses, the delay of the loop."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from afm_rl.diagnosis.changes import Channel, Parts
from afm_rl.diagnosis.findings import Actuator, Interval, shifted
from afm_rl.diagnosis.log import Log
from afm_rl.diagnosis.model import FLOOR, Model, Problem, lost
from afm_rl.diagnosis.refine import interval_widths, refine
from afm_rl.diagnosis.scale import middle_of
from afm_rl.diagnosis.settings import Settings
from afm_rl.diagnosis.words import UNITS, is_far, known_unit

WEAK = {"delay": 0.1, "keep": 0.05, "rate": 2.0, "dead_zone": 0.01, "play": 0.01, "cut": 1.0}
WEAK |= {"low": -1.0, "high": 1.0}
"""Numbers with which next to nothing happens, in half ranges and steps."""


def kind_of(name: str) -> str:
    """Return what is left of a name without sides and numbers.

    >>> kind_of("kLeftShoulderPitch"), kind_of("wheel_fl_2"), kind_of("left"), kind_of("b")
    ('k shoulder pitch', 'wheel', '', 'b')
    """
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)
    if len(name) < 2:
        return name
    sides = set("left right front rear back fl fr rl rr bl br lf rf lh rh lr l r f b".split())
    return " ".join(word.lower() for word in words if word.lower() not in sides)


def _kinds(names: Mapping[int, str]) -> Iterable[list[int]]:
    """Return the numbers of the actuators of each kind."""
    kinds = defaultdict(list)
    for j, name in names.items():
        kinds[kind_of(name)].append(j)
    return kinds.values()


def small_twins(names: Sequence[str], ranges: np.ndarray, small: float = 1 / 3) -> dict[int, str]:
    """Return the actuators that move far less than their twin on the other side, and what to say.

    >>> small_twins(["left_elbow", "right_elbow", "head"], np.array([0.1, 1.0, 0.2]))
    {0: 'it moves by 10 % of what right_elbow does, and friction looks like a fault; move it more'}
    """
    notes = {}
    for one, other in (pair for pair in _kinds(dict(enumerate(names))) if len(pair) == 2):
        low, high = sorted((one, other), key=lambda j: ranges[j])
        if 0 < ranges[low] < small * ranges[high]:
            notes[low] = (
                f"it moves by {100 * ranges[low] / ranges[high]:.0f} % of what {names[high]} does, "
                "and friction looks like a fault; move it more"
            )
    return notes


def agree(log: Log, parts_of: Parts, reach: np.ndarray, settings: Settings) -> Parts:
    """Return the parts of all actuators, those of one kind with the same numbers.

    Of the sets of numbers that the members were found to need, the one that is best for all of them
    together (BIC) is fitted to each. Members that changed, or follow another command, stay, and so
    does who is clearly worse explained, or less certain, with the numbers of all.
    """
    single = {j: parts[0] for j, parts in parts_of.items() if len(parts) == 1}
    single = {j: part for j, part in single.items() if part.model.driver == j}
    better = dict(parts_of)
    for members in _kinds({j: log.names[j] for j in single}):
        if len({single[j].model.active for j in members}) < 2:
            continue
        channels = [Channel(log, j, settings).thinned() for j in members]
        problems = {each.j: each.problem(single[each.j].lead) for each in channels}
        rows = {j: len(problem.y) * single[j].weight for j, problem in problems.items()}
        options = []
        for pattern in (single[j].model for j in members):
            models = {j: _like(problems[j], single[j].model, pattern) for j in members}
            score = sum(
                rows[j] * math.log(model.cost + FLOOR) + settings.price(rows[j]) * model.size
                for j, model in models.items()
            )
            options.append((score, models))
        _, models = min(options, key=lambda option: option[0])
        rates = [models[j].shape.rate * reach[j] for j in members]
        if max(rates) > 2 * min(rates):  # a limit that another one exceeds is none
            models = {j: _without_rate(problems[j], model) for j, model in models.items()}
        for j, model in models.items():
            alone = single[j].model
            less = lost(rows[j], model.cost, alone.cost)
            own, shared = (interval_widths(problems[j], m)[0] for m in (alone, model))
            blurred = shared > max(1.5 * own, settings.matters * abs(model.gain))
            if less < settings.price(rows[j]) and not blurred:
                better[j] = [replace(single[j], model=model)]
    return better


def _without_rate(problem: Problem, model: Model) -> Model:
    """Return a model whose rate limit is a lag instead."""
    active = sorted({*model.active, "keep"} - {"rate"})
    slow = model.with_shape(active, rate=math.inf, keep=model.shape.keep or 0.5)
    return refine(problem, [slow])[0]


def _like(problem: Problem, own: Model, pattern: Model) -> Model:
    """Return a model with the numbers that another one needs."""
    if own.active == pattern.active:
        return refine(problem, [own])[0]
    shared = {name: getattr(own.shape, name) for name in own.active if name in pattern.active}
    weak = {name: WEAK[name] for name in pattern.active if name in WEAK}
    there = pattern.shape._asdict()
    models = [own.with_shape(pattern.active, **there | x) for x in ({}, shared, weak | shared)]
    return min(refine(problem, models), key=attrgetter("cost"))


def in_units(
    actuators: Sequence[Sequence[Actuator]], settings: Settings
) -> tuple[list[list[Actuator]], tuple[str, ...]]:
    """Return the parts of all actuators beside healthy ones in the unit of the log, and its name.

    A healthy gain is 1, or that of two known units if the intervals of at least half of the
    actuators hold it, or what more than half have in common if it is so large or small that no
    actuator is to blame. Where they have an offset in common as well, responses are counted from
    there.
    """
    clear = [a for (*_, a) in actuators if a.signed]
    clear = [a for a in clear if not a.units[0] or a.units[0] != a.units[1]]  # told to be equal
    units = Counter(known_unit(a.gain_interval, settings) for a in clear)
    name = max(("", *UNITS), key=lambda name: units[name])
    gains = [abs(a.gain) for a in clear]
    alike = _alike(gains, [settings.matters * gain for gain in gains])
    shared = float(np.median(alike)) if len(alike) > 1 else 1.0
    unit, zero, note = 1.0, 0.0, ""
    if name and 2 * units[name] >= len(clear):
        unit, note = UNITS[name], f"all responses are in {name}"
    elif is_far(shared):
        unit, note = shared, "all responses are in another unit"
    if note:
        command, response = clear[0].units
        of = f" {response} per {command}" if command else " per unit of the command"
        note += f": {unit:.4g}{of}" + ", or commands are taken for that unit" * bool(name)
        offsets = [_deviation(a, middle_of(a.command_range), unit)[0] for a in clear]
        sizes = [settings.matters * unit * a.reach for a in clear]
        alike = _alike(offsets, sizes)
        if len(alike) > 1 and abs(np.median(alike)) > max(sizes):
            zero = float(np.median(alike))
            note += f", counted from {zero:.4g}"
    parts = [[_in_unit(part, unit, zero, settings) for part in parts] for parts in actuators]
    return parts, (note,) if note else ()


def _alike(values: Sequence[float], apart: Sequence[float]) -> list[float]:
    """Return the values around one of them that are more than half of all; none if there are none.

    >>> _alike([1.0, 1.1, 9.0], [0.2, 0.2, 0.2]), _alike([1.0, 9.0], [0.2, 0.2])
    ([1.0, 1.1], [])
    """
    near = [
        [value for value in values if abs(value - one) <= size]
        for one, size in zip(values, apart, strict=True)
    ]
    most = max(near, key=len, default=[])
    return most if 2 * len(most) > len(values) else []


def _deviation(actuator: Actuator, centre: float, healthy: float) -> tuple[float, Interval]:
    """Return how far the response at 0, or in the middle, is from ``healthy * centre``."""
    response, ends = actuator.offset, actuator.offset_interval
    if centre:
        response, ends = actuator.level, actuator.level_interval
    return response - healthy * centre, shifted(ends, -healthy * centre)


def _in_unit(actuator: Actuator, unit: float, zero: float, settings: Settings) -> Actuator:
    """Return the actuator with its healthy gain, and the offset from a healthy response.

    The offset is that at 0 or in the middle of the commands, wherever it is smaller: a gripper that
    answers 100 - u to commands of 0 to 100 is reversed about its middle.
    """
    centre, middle = middle_of(actuator.command_range), actuator.middle
    offset, ends = _deviation(actuator, centre, unit)
    if abs(middle) > 0.25 * actuator.reach:
        other = 0.0 if centre else middle
        instead, ends_instead = _deviation(actuator, other, unit)
        if abs(offset - zero) > max(
            settings.matters * unit * actuator.reach, 2 * abs(instead - zero)
        ):
            centre, offset, ends = other, instead, ends_instead
    if actuator.reversed and centre:  # the ends of its range are known by the commands alone
        met = centre + (offset - zero) / (unit - actuator.gain)
        if abs(met - centre) < 2 * settings.matters * actuator.reach:
            centre, ends, offset = met, shifted(ends, zero - offset), zero
    shift = offset - zero - actuator.offset
    return replace(
        actuator,
        unit=unit,
        zero=zero,
        centre=centre,
        offset=offset - zero,
        offset_interval=shifted(ends, -zero),
        offsets={name: value + shift for name, value in actuator.offsets.items()},
        drift={
            name: shifted(ends, shift * (name == "offset")) for name, ends in actuator.drift.items()
        },
    )


def shared_delay(
    actuators: Sequence[Actuator], log: Log, settings: Settings
) -> tuple[float, tuple[str, ...]]:
    """Return delay and lag that are no fault of an actuator (s), and what to say of the loop.

    Where all that are known are late, that is the loop's: bus, controller, logger. Arms and hands
    may have a loop each: what a fifth of the actuators share is no fault of one, and what one is
    later than all of these is.
    """
    known = [a for a in actuators if _is_timed(a, log.step)]
    times = np.array([max(a.delay_s, 0.0) + a.lag_s for a in known])
    usual = log.usual_delay
    late = usual + settings.late * log.step
    if settings.shared is None or len(times) < 2:
        return usual, ()
    if (times > late).mean() < (1.0 if len(times) < 5 else 0.8):
        return usual, ()
    alike = np.abs(times - times[:, None]) <= np.maximum(settings.shared * times, log.step)
    shared = alike.sum(1) > max(1.0, 0.2 * len(times))
    if shared.sum() < 0.6 * len(times):
        return usual, ()
    middle, most = float(np.median(times)), float(times[shared].max())
    near = times[(times <= most) & (times > late)]
    delay, lag = (float(np.median([getattr(a, n) for a in known])) for n in ("delay_s", "lag_s"))
    parts = [f"a delay of {_span([delay], log)}", f"a lag of {_span([lag], log)}"]
    causes = [text for text, time in zip(parts, (delay, lag), strict=True) if time > 0.1 * middle]
    note = (
        f"all actuators are {_span(near, log)} behind their commands ({' and '.join(causes)}): "
        "that is the loop's, and no fault of one of them"
    )
    return max(most, usual), (note,)


def _is_timed(actuator: Actuator, step: float) -> bool:
    """Return whether delay and lag of an actuator are known."""
    low, high = actuator.time_interval
    return actuator.signed and high - low < max(low + high, 2 * step)


def _span(times: Sequence[float] | np.ndarray, log: Log) -> str:
    """Return from which time to which, in steps and, if these are known, seconds."""
    low, high = min(times), max(times)
    texts = [f"{time / log.step:.2g}" for time in (low, high)]
    seconds = [f"{time:.2g}" for time in (low, high)]
    steps, known = (" to ".join(dict.fromkeys(ends)) for ends in (texts, seconds))
    return f"{steps} steps" + (f" ({known} s)" if log.step != 1.0 else "")
