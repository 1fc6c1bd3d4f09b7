"""What numbers mean: is an actuator healthy, and what is wrong with it in words."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from afm_rl.diagnosis.findings import Actuator, Interval, Status

UNITS = {
    "degrees for radians": 180 / math.pi,
    "radians for degrees": math.pi / 180,
    "mm for m": 1000.0,
    "m for mm": 0.001,
    "rpm for rad/s": 30 / math.pi,
    "rad/s for rpm": math.pi / 30,
}
"""Gain of a healthy actuator whose response is in another unit than its command."""
MATTERS = 0.05
"""Share of the gain, or of half the range of commands: smaller deviations are no fault."""
DEAD = 0.1
"""Share of the usual gain: an actuator whose whole interval is below does not answer."""
VAGUE = 0.25
"""Share of the usual gain: where the interval is wider to either side, nothing can be told."""
LATE = 0.5
"""Steps: smaller delays and lags are no fault."""
FOLLOWS = 0.2
"""Share of the variance: a response of which less is unexplained does follow, however little."""
LEFT = 0.25
"""Share of the variance: what leaves more than that unexplained says so."""
SURE = 1.45
"""Times the 95 % interval: what a fault has to exceed, so that few are false (99.95 %)."""


def judge(
    actuator: Actuator, step: float = 1.0, usual_delay: float = 0.0, doubt: str = ""
) -> Actuator:
    """Return the actuator with its status and its sentence.

    A fault is a deviation that is significant and large enough to matter: more than 5 % of the
    gain or of half the range of commands, or half a step of delay.

    Args:
        actuator: with all numbers.
        step: time between two rows (s).
        usual_delay: delay and lag of the healthy robot (s).
        doubt: why nothing can be told, if the log shows so.

    >>> elbow = Actuator(name="elbow", gain=-0.62, gain_interval=(-0.63, -0.61), reversed=True,
    ...                  command_range=(-1.0, 1.0), delay_s=0.04)
    >>> judge(elbow, step=0.02).sentence
    'elbow: reversed, 62 % of the command, 2 steps late'
    """
    faults = list(_faults(actuator, step, usual_delay))
    low, high = actuator.gain_interval
    width = 0.5 * (high - low) / actuator.unit
    size = abs(actuator.gain) / actuator.unit
    status: Status
    if doubt:
        status, faults = "cannot tell", [f"cannot tell: {doubt}"]
    elif (
        max(-low, high) < DEAD * actuator.unit
        and actuator.driven_by is None
        and actuator.gain_down is None
        and not (outside(widened((low, high))) and actuator.unexplained < FOLLOWS)
    ):
        status, faults = "dead", ["does not answer its command"]
    elif not width < VAGUE * max(1.0, size) and not (faults and not low <= 0.0 <= high):
        status, faults = "cannot tell", [f"cannot tell: {_reason(actuator)}"]
    else:
        status = "changed" if faults else "healthy"
        if faults and actuator.unexplained > LEFT:
            faults.append(f"{100 * actuator.unexplained:.0f} % of its motion unexplained")
    if actuator.changes:
        last = actuator.changes[-1]
        was = last.before.sentence.partition(": ")[2] or last.before.status
        now = ", ".join(faults) or "healthy"
        faults = [f"changed at {last.t:.4g} s: {was}, then {now}"]
        status = "dead" if status == "dead" else "changed"
    sentence = f"{actuator.name}: {', '.join(faults) or 'healthy'}"
    return replace(actuator, status=status, sentence=sentence)


def _reason(actuator: Actuator) -> str:
    if not actuator.reach > 0:
        return "its command hardly changes"
    return "its command does not stand out from the noise or from other commands"


def _faults(actuator: Actuator, step: float, usual_delay: float) -> Iterator[str]:
    """Yield what is wrong, in words."""
    unit, reach = actuator.unit, actuator.reach
    low, high = (end / unit for end in widened(actuator.gain_interval))
    share = abs(actuator.gain) / unit
    other = actuator.driven_by
    if other is not None and other not in actuator.coupling:
        yield f"follows the command of {other}"
    if actuator.reversed:
        yield "reversed"
        low, high = -high, -low
    down = actuator.gain if actuator.gain_down is None else actuator.gain_down
    if abs(down - actuator.gain) > MATTERS * unit:
        sides = 100 * actuator.gain / unit, 100 * down / unit
        yield f"{sides[0]:.0f} % of positive commands, {sides[1]:.0f} % of negative ones"
    elif "gain" in actuator.drift:
        pass
    elif not low <= 1.0 <= high and abs(share - 1.0) > MATTERS:
        odd = [name for name, gain in UNITS.items() if abs(share / gain - 1.0) < MATTERS]
        yield (
            f"{share:.3g} times its command: {odd[0]}"
            if odd
            else (f"{100 * share:.0f} % of the command")
        )
    for name, gain in actuator.coupling.items():
        yield f"takes in {100 * gain / unit:+.0f} % of the command of {name}"
    if (
        "offset" not in actuator.drift
        and outside(widened(actuator.offset_interval))
        and abs(actuator.offset) > MATTERS * unit * reach
    ):
        yield f"offset {actuator.offset:+.3g}"
    if actuator.quantum > MATTERS * unit * reach:
        yield f"moves in steps of {actuator.quantum:.3g}"
    if actuator.dead_zone > max(MATTERS * reach, actuator.quantum / unit):
        yield f"no motion for commands below {actuator.dead_zone:.3g}"
    if actuator.saturation is not None:
        yield f"no more for commands beyond {actuator.saturation:.3g}"
    if actuator.backlash > max(MATTERS * reach, actuator.quantum / unit):
        yield f"play of {2 * actuator.backlash:.3g}"
    if actuator.stick > max(MATTERS * reach, actuator.quantum / unit):
        yield f"sticks for changes below {actuator.stick:.3g}"
    if actuator.delay_s > usual_delay + LATE * step:
        yield f"{_steps(actuator.delay_s / step)} late"
    if actuator.delay_s + actuator.lag_s > usual_delay + LATE * step and (
        actuator.lag_s > LATE * step
    ):
        yield f"a lag of {_steps(actuator.lag_s / step)}"
    if actuator.lost:
        yield f"does not follow in {100 * actuator.lost:.0f} % of the rows"
    for name, (begin, end) in actuator.drift.items():
        yield f"{name} drifts from {begin:.3g} to {end:.3g}"


def widened(interval: Interval) -> Interval:
    """Return the interval that a fault has to exceed.

    >>> widened((-1.0, 1.0))
    (-1.45, 1.45)
    """
    low, high = interval
    if high - low == float("inf"):
        return interval
    middle, half = 0.5 * (low + high), 0.5 * SURE * (high - low)
    return middle - half, middle + half


def outside(interval: Interval) -> bool:
    """Return whether 0 is outside of an interval."""
    return not interval[0] <= 0.0 <= interval[1]


def _steps(count: float) -> str:
    """Return a number of steps in words.

    >>> _steps(1.04), _steps(2.5)
    ('1 step', '2.5 steps')
    """
    text = f"{count:.1f}".removesuffix(".0")
    return f"{text} step{'' if text == '1' else 's'}"
