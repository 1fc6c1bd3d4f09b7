"""What numbers mean: is an actuator healthy, and what is wrong with it in words."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from afm_rl.diagnosis.findings import Actuator, Interval, Status
from afm_rl.diagnosis.pattern import OWN

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
SWITCH = 0.2
"""Share of half the range of commands: what saturates below switches."""
DEAD = 0.1
"""Share of the usual gain: an actuator whose whole interval is below does not answer."""
VAGUE = 0.25
"""Share of the usual gain: where the interval is wider to either side, nothing can be told."""
LATE = 0.5
"""Steps: smaller delays and lags are no fault."""
FOLLOWS = 0.6
"""Share of the variance: a response of which less is unexplained does follow, however little."""
LEFT = 0.05
"""Share of the variance: what leaves more than that unexplained says so."""
MISFIT = 0.005
"""Share of the variance: what is unexplained and no noise is told if it is more than that."""
UNKNOWN = 0.1, 0.3
"""Share of the variance that is predicted, or unexplained: no known fault fits."""
MOVES = 0.9
"""Share of the variance: a response of which more is unexplained has another cause."""
NO_FAULT, FEW = "no known fault", 3  # parts of a log
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
    own = any(name in actuator.pattern for name in OWN)
    coarse = actuator.noise < 0.5 * actuator.quantum  # that is what is left
    noticed = bool(actuator.pattern) and actuator.unexplained > MISFIT and not coarse
    unclear = low <= 0.0 <= high
    if doubt:
        status, faults = "cannot tell", [f"cannot tell: {doubt}"]
    elif actuator.misfit > UNKNOWN[0] or noticed and actuator.unexplained > UNKNOWN[1]:
        closest = "" if unclear else _closest(faults)
        status, faults = "changed", [f"{NO_FAULT}: {_rest(actuator)}{closest}"]
    elif (
        max(-low, high)
        < (VAGUE if unclear or actuator.unexplained > MOVES else DEAD) * actuator.unit
        and actuator.driven_by is None
        and actuator.gain_down is None
        and not (outside(widened((low, high))) and actuator.unexplained < FOLLOWS)
        and not own
    ):
        status, faults = "dead", ["does not answer its command"]
    elif not width < VAGUE * max(1.0, size) and not (faults and not unclear):
        status, faults = "cannot tell", [f"cannot tell: {_reason(actuator)}"]
    else:
        status = "changed" if faults or noticed else "healthy"
        if faults and actuator.unexplained > UNKNOWN[1]:
            faults = [_rest(actuator) + _closest(faults)]
        elif noticed or actuator.unexplained > LEFT:
            faults = [*(faults or [f"{'nearly ' if noticed else ''}healthy"]), _rest(actuator)]
    if actuator.changes:
        now = ", ".join(faults) or "healthy"
        first, *more = actuator.changes
        story = f"changed at {first.t:.4g} s: {_said(first.before)}, then "
        story += "".join(f"{_said(c.before)}; at {c.t:.4g} s " for c in more)
        parts = [now, *(_said(c.before) for c in actuator.changes)]
        if len(parts) > FEW and any(NO_FAULT in part for part in parts):
            story, now = f"{NO_FAULT}: ", f"no explanation holds longer than a part of {len(parts)}"
        faults = [story + now]
        status = "dead" if status == "dead" else "changed"
    sentence = f"{actuator.name}: {', '.join(faults) or 'healthy'}"
    return replace(actuator, status=status, sentence=sentence)


def _said(actuator: Actuator) -> str:
    return actuator.sentence.partition(": ")[2] or actuator.status


def _closest(faults: list[str]) -> str:
    return f"; closest: {', '.join(faults)}" if faults else ""


def _rest(actuator: Actuator) -> str:
    """Return how much is unexplained, and what it depends on."""
    share = (
        f"{100 * actuator.unexplained:.2g}"
        if actuator.unexplained < 0.1
        else (f"{100 * actuator.unexplained:.0f}")
    )
    on = f" ({actuator.pattern})" if actuator.pattern else ""
    return f"{share} % of its motion unexplained{on}"


def _reason(actuator: Actuator) -> str:
    if not actuator.reach > 0:
        return "its command hardly changes"
    if actuator.unexplained < FOLLOWS and actuator.pattern:
        return _rest(actuator)
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
    cut = actuator.saturation
    switches = cut is not None and cut < SWITCH * reach
    down = actuator.gain if actuator.gain_down is None else actuator.gain_down
    if switches:
        yield "switches between two responses, whatever the size of its command"
    elif abs(down - actuator.gain) > MATTERS * unit:
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
        and not switches
        and outside(widened(actuator.offset_interval))
        and abs(actuator.offset) > MATTERS * unit * reach
    ):
        yield f"offset {actuator.offset:+.3g}"
    if actuator.quantum > MATTERS * unit * reach:
        yield f"moves in steps of {actuator.quantum:.3g}"
    if actuator.dead_zone > max(MATTERS * reach, actuator.quantum / unit):
        yield f"no motion for commands below {actuator.dead_zone:.3g}"
    if cut is not None and not switches:
        yield f"no more for commands beyond {cut:.3g}"
    if actuator.backlash > max(MATTERS * reach, actuator.quantum / unit):
        yield f"play of {2 * actuator.backlash:.3g}"
    if actuator.stick > max(MATTERS * reach, actuator.quantum / unit):
        yield f"sticks for changes below {actuator.stick:.3g}"
    if actuator.rate is not None:
        yield f"no faster than {actuator.rate:.3g} per second"
    if actuator.every > 1:
        yield f"takes over one of {actuator.every} commands only"
    if actuator.delay_s < -LATE * step:
        yield f"answers {_steps(-actuator.delay_s / step)} before its command in the log"
    if actuator.delay_s > usual_delay + LATE * step:
        yield f"{_steps(actuator.delay_s / step)} late"
    if actuator.delay_s + actuator.lag_s > usual_delay + LATE * step and (
        actuator.lag_s > LATE * step
    ):
        yield f"a lag of {_steps(actuator.lag_s / step)}"
    if actuator.turn:
        yield f"jumps by {actuator.turn:.4g}: an angle that is not unwrapped"
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
