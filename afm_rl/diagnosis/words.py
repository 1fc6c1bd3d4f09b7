"""What numbers mean: is an actuator healthy, and what is wrong with it in words."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from afm_rl.diagnosis.findings import Actuator, Interval, Status
from afm_rl.diagnosis.residuals import OWN
from afm_rl.diagnosis.settings import Settings

UNITS = {
    "degrees for radians": 180 / math.pi,
    "radians for degrees": math.pi / 180,
    "mm for m": 1000.0,
    "m for mm": 0.001,
    "rpm for rad/s": 30 / math.pi,
    "rad/s for rpm": math.pi / 30,
}
"""Gain of a healthy actuator whose response is in another unit than its command."""
NO_FAULT = "no known fault"
CLEAR, EXACT = 1e-3, 1e-6  # shares of the variance that are left unexplained


def is_far(gain: float) -> bool:
    """Is a gain so large or small that another unit is to blame, and no actuator?"""
    return not 1 / 30 < gain < 30


def known_unit(interval: Interval, settings: Settings) -> str:
    """Return the name of the unit whose gain an interval holds; empty if it may be 1, or is none.

    A gain near 1 / 30 to 30 that is not known to 5 % may be an actuator's own.

    >>> known_unit((57.0, 57.5), Settings()), known_unit((9.98, 10.01), Settings())
    ('degrees for radians', '')
    """
    low, high = sorted(abs(end) for end in widened(interval, settings))
    if low <= 1.0 + settings.matters and high >= 1.0 - settings.matters:
        return ""
    for name, gain in UNITS.items():
        known = settings.vague if is_far(gain) else settings.matters
        if low <= gain <= high and high - low < 2 * known * gain:
            return name
    return ""


def judge(
    actuator: Actuator,
    step: float = 1.0,
    usual_delay: float = 0.0,
    doubt: tuple[Status, str] | None = None,
    settings: Settings | None = None,
) -> Actuator:
    """Return the actuator with its status and its sentence.

    A fault is a deviation that is significant and large enough to matter: more than 5 % of the
    gain or of half the range of commands, or half a step of delay. A step of 1 s is a row of a log
    without times: nothing is said in seconds then.

    >>> elbow = Actuator(name="elbow", gain=-0.62, gain_interval=(-0.63, -0.61), reversed=True,
    ...                  command_range=(-1.0, 1.0), delay_s=0.04)
    >>> judge(elbow, step=0.02).sentence
    'elbow: reversed, 62 % of the command, 2 steps (0.04 s) late'
    """
    s = settings or Settings()
    status, faults = _judged(actuator, step, usual_delay, s)
    doubt = doubt or _doubt(actuator, status, s)
    if doubt:
        status, faults = doubt[0], [f"{doubt[0]}: {doubt[1]}"]
    if actuator.changes and not doubt:
        faults = [_story(actuator, step)]
        statuses = {piece.status for _, piece in actuator.pieces}
        if status != "dead":
            status = "changed" if statuses & {"changed", "dead"} else "cannot tell"
    sentence = f"{actuator.name}: {', '.join(faults) or 'healthy'}"
    if actuator.copies and status in ("healthy", "changed"):
        sentence += f" (if it follows its own command: {_copied(actuator)} the same up to a factor)"
    return replace(actuator, status=status, sentence=sentence)


def _judged(
    actuator: Actuator, step: float, usual_delay: float, s: Settings
) -> tuple[Status, list[str]]:
    """Return the status of an actuator that did not change, and what is wrong with it."""
    faults = list(_faults(actuator, step, usual_delay, s))
    low, high = actuator.gain_interval
    width = 0.5 * (high - low) / actuator.unit
    size = abs(actuator.gain) / actuator.unit
    coarse = actuator.noise < 0.5 * actuator.quantum  # that is what is left
    unexplained = actuator.unexplained - actuator.lost
    noticed = bool(actuator.pattern) and unexplained > 0.005 and not coarse
    unclear = low <= 0.0 <= high
    follows = unexplained < 0.6  # of the variance: that little is the command, for certain
    vague = not width < s.vague * max(1.0, size) and not (actuator.switches and follows)
    own = any(name in actuator.pattern for name in OWN)
    excited = own or not vague or max(-low, high) < actuator.unit  # or it may as well be healthy
    if excited and (actuator.misfit > 0.1 or noticed and unexplained > s.unknown):
        closest = "" if unclear or vague else _closest(faults)
        return "changed", [f"{NO_FAULT}: {_rest(actuator)}{closest}"]
    if (
        max(-low, high) < (s.vague if unclear or unexplained > 0.9 else s.dead) * actuator.unit
        and actuator.driven_by is None
        and actuator.gain_down is None
        and not (outside(widened((low, high), s)) and follows)
        and not own
    ):
        return "dead", ["does not answer its command"]
    surely = actuator.gain + s.sure * (high - actuator.gain) < 0  # whatever else is not known
    if vague and actuator.reversed and follows and surely:
        near, far = (100 * abs(end) / actuator.unit for end in (high, low))
        span = f"{near:.0f} to {far:.0f}" if far < 3 * near else f"at least {near:.0f}"
        return "changed", ["reversed", f"{span} % of the command"]
    if vague:
        return "cannot tell", [f"cannot tell: {_reason(actuator)}"]
    ends, stops = actuator.limits, []  # of a healthy joint
    if ends is not None and _followed(actuator) >= s.followed:
        stops = [f"no more for commands {_beyond(ends, actuator, _unit(actuator, 0))}"]
    if not faults and not noticed:
        said = [*stops, *([_rest(actuator)] if unexplained > s.left else [])]
        return "healthy", ["healthy", *said] if said else []
    if faults and unexplained > s.unknown:
        return "changed", [_rest(actuator) + _closest(faults)]
    status: Status = "changed" if faults or unexplained > s.left else "healthy"
    if noticed or unexplained > s.left:
        faults = [*(faults or ["nearly healthy"]), _rest(actuator)]
    return status, [*faults, *stops]


def _doubt(actuator: Actuator, status: Status, s: Settings) -> tuple[Status, str] | None:
    """Return why a verdict is none: a command that did not move, or a response of its own.

    Who accuses an actuator must have seen its command go up and down twice; once, where that
    explains nearly all of the response: two slow drifts resemble each other.
    """
    needed, left = s.travel, actuator.unexplained
    if actuator.driven_by in (None, *actuator.coupling) and left < CLEAR:
        needed = min(1.2, needed) if left > EXACT else 0.0
    if status in ("changed", "dead") and actuator.travel < needed:
        times = f"{actuator.travel:.0f} times from end to end"
        return "cannot tell", f"its command goes {times} only; move it up and down"
    if status == "healthy" and actuator.unexplained - actuator.lost > s.unknown:
        text = f"{100 * actuator.unexplained:.0f} % of its motion is not its command's"
        return "cannot tell", f"{text}; larger moves, of it alone, would tell"
    return None


def _story(actuator: Actuator, step: float) -> str:
    """Return what an actuator that changed did, piece by piece, with times."""
    begins = ["", *(_when(change.t, step) for change in actuator.changes)]
    texts = [_said(piece) for _, piece in actuator.pieces]
    faulty = [k for k, (_, piece) in enumerate(actuator.pieces) if piece.status != "healthy"]
    if len({texts[k] for k in faulty}) > 1 and any(NO_FAULT in texts[k] for k in faulty):
        none = f"{NO_FAULT}, no explanation of it holds longer than a part of {len(texts)}"
        texts[faulty[0] : faulty[-1] + 1] = [none]  # as one, of which nothing else is known
        del begins[faulty[0] + 1 : faulty[-1] + 1]
    story = []
    for text, begin, end in zip(texts, begins, [*begins[1:], ""], strict=True):
        if not end:
            story.append("healthy since" if text == "healthy" else f"{text}, since {begin}")
        elif text != "healthy":
            between = f"from {begin} to {end.removeprefix('step ')}" if begin else f"until {end}"
            story.append(f"{text}{',' * (',' in text)} {between}")
    return "; ".join(story).replace("; healthy since", ", healthy since").removesuffix(", since ")


def _said(actuator: Actuator) -> str:
    """Return the sentence without the name, and without the advice where the log cannot tell."""
    said = actuator.sentence.partition(": ")[2]
    return said.partition(";")[0] if actuator.status == "cannot tell" else said


def _closest(faults: list[str]) -> str:
    return f"; closest: {', '.join(faults)}" if faults else ""


def _copied(actuator: Actuator) -> str:
    first, *others = actuator.copies
    return f"that of {first} is" if not others else f"those of {len(actuator.copies)} others are"


def _rest(actuator: Actuator) -> str:
    """Return how much is unexplained, and what it depends on."""
    share = 100 * actuator.unexplained
    text = f"{share:.2g}" if share < 10 else f"{share:.0f}"
    on = f" ({actuator.pattern})" if actuator.pattern else ""
    return f"{text} % of its motion unexplained{on}"


def _reason(actuator: Actuator) -> str:
    """Return why the gain is not known, and what would tell."""
    low, high = (100 * end / actuator.unit for end in actuator.gain_interval)
    if not actuator.reach > 0:
        return "its command hardly changes; move it"
    if not math.isfinite(low + high):
        return "its command does not stand out from others; move it alone"
    if actuator.unexplained < 0.6:
        known = "not reversed, but " * (low > 0) + "its gain is anything from "
        return f"{known}{low:.0f} to {high:.0f} %; more moves, in both directions, would tell"
    return (
        "its command does not stand out from the noise or from other commands; larger moves, of "
        "it alone, would tell"
    )


def _faults(actuator: Actuator, step: float, usual_delay: float, s: Settings) -> Iterator[str]:
    """Yield what is wrong, in words."""
    other = actuator.driven_by
    if other is not None and other not in actuator.coupling:
        yield f"follows the command of {other}"
    size = s.matters * actuator.unit * actuator.reach
    known = outside(widened(actuator.offset_interval, s))
    shifted = not actuator.offsets and known and abs(actuator.offset) > size
    near, far = sorted(abs(end) for end in widened(actuator.gain_interval, s))
    switches = actuator.switches and not near <= actuator.unit <= far
    yield from _sign(actuator, shifted)
    yield from _gain(actuator, switches, s)
    yield from _offset(actuator, shifted and not switches)
    yield from _motion(actuator, switches, step, s)
    yield from _timing(actuator, step, usual_delay, s)
    if actuator.lost:
        yield f"does not follow in {100 * actuator.lost:.0f} % of the rows"
    for name, (begin, end) in actuator.drift.items():
        unit = _unit(actuator, 1) if name == "offset" else ""
        yield f"{name} drifts from {begin:.3g} to {end:.3g}{unit}"


def _unit(actuator: Actuator, place: int) -> str:
    """Return the unit of commands (0) or responses (1), as it stands behind a number."""
    return f" {actuator.units[place]}" * bool(actuator.units[place])


def _sign(actuator: Actuator, shifted: bool) -> Iterator[str]:
    """Yield whether it is reversed, and about what."""
    if actuator.reversed_while:
        yield f"reversed while {actuator.reversed_while}"
    elif actuator.reversed and actuator.centre and not shifted:
        yield f"reversed about its middle ({actuator.centre:.3g}{_unit(actuator, 0)})"
    elif actuator.reversed:
        yield "reversed"


def _gain(actuator: Actuator, switches: bool, s: Settings) -> Iterator[str]:
    """Yield how much it moves, by its own command and by others."""
    unit, share = actuator.unit, abs(actuator.gain) / actuator.unit
    low, high = (end / unit for end in widened(actuator.gain_interval, s))
    if actuator.reversed_while:
        low, high = sorted((abs(low), abs(high)))
    elif actuator.reversed:
        low, high = -high, -low
    moves = "the moves of its command" if actuator.centre else "the command"
    down = actuator.gain if actuator.gain_down is None else actuator.gain_down
    if switches:
        yield "switches between two responses, whatever the size of its command"
    elif abs(down - actuator.gain) > s.matters * unit:
        sides = 100 * actuator.gain / unit, 100 * down / unit
        yield f"{sides[0]:.0f} % of positive commands, {sides[1]:.0f} % of negative ones"
    elif "gain" not in actuator.drift and not low <= 1.0 <= high and abs(share - 1.0) > s.matters:
        odd = known_unit((actuator.gain_interval[0] / unit, actuator.gain_interval[1] / unit), s)
        times = f"{share:.3g} times {moves}" + f": {odd}" * bool(odd)
        yield times if odd or share > 3 else f"{100 * share:.0f} % of {moves}"
    for name, gain in actuator.coupling.items():
        yield f"takes in {100 * gain / unit:+.0f} % of the command of {name}"


def _offset(actuator: Actuator, shifted: bool) -> Iterator[str]:
    """Yield how far it is from where it should be."""
    command, response = _unit(actuator, 0), _unit(actuator, 1)
    if shifted and "offset" not in actuator.drift:
        at = f" at {actuator.centre:.3g}{command}" if actuator.centre else ""
        low, high = actuator.command_bounds or actuator.command_range
        share = 100 * abs(actuator.offset) / ((high - low) * actuator.unit)
        of = f" ({share:.0f} % of its range)" if share <= 100 or actuator.command_bounds else ""
        yield f"offset {actuator.offset:+.3g}{response}{of}{at}"
    if actuator.offsets:
        each = [f"{value:+.3g}{response} in {where}" for where, value in actuator.offsets.items()]
        yield f"an offset that differs by episode: {', '.join(each)}"


def _motion(actuator: Actuator, switches: bool, step: float, s: Settings) -> Iterator[str]:
    """Yield what keeps it from going where the command is, and how fast it goes."""
    command, response = _unit(actuator, 0), _unit(actuator, 1)
    small = max(s.matters * actuator.reach, actuator.quantum / actuator.unit)
    if actuator.quantum > s.matters * actuator.unit * actuator.reach:
        yield f"moves in steps of {actuator.quantum:.3g}{response}"
    if actuator.dead_zone > small:
        yield f"no motion for commands below {actuator.dead_zone:.3g}{command}"
    ends = actuator.limits
    if ends is not None and not switches and (share := _followed(actuator)) < s.followed:
        of = f" ({100 * share:.0f} % of the range)" if share < 0.2 else ""
        yield f"no more for commands {_beyond(ends, actuator, command)}{of}"
    if actuator.backlash > small:
        yield f"play of {2 * actuator.backlash:.3g}{command}"
    if actuator.stick > small:
        yield f"sticks for changes below {actuator.stick:.3g}{command}"
    if actuator.rate is not None:
        time = "second" if step != 1.0 else "row"
        yield f"no faster than {actuator.rate:.3g}{response} per {time}"
    if actuator.every > 1:
        yield f"takes over one of {actuator.every} commands only"


def _timing(actuator: Actuator, step: float, usual_delay: float, s: Settings) -> Iterator[str]:
    """Yield what is wrong with the time that an actuator takes."""
    delay, lag, late = actuator.delay_s, actuator.lag_s, s.late * step
    if widened(actuator.time_interval, s)[0] < usual_delay < delay + lag:
        usual_delay = delay + lag  # it may as well be the usual one
    if delay < -late:
        yield f"answers {_steps(-delay, step)} before its command in the log"
    if delay > usual_delay + late:
        yield f"{_steps(delay, step)} late"
    if delay + lag > usual_delay + late and lag > late:
        yield f"a lag of {_steps(lag, step)}"


def _followed(actuator: Actuator) -> float:
    """Return the share of the range of commands that is followed."""
    (low, high), (first, last) = actuator.followed, actuator.command_range
    return (min(high, last) - max(low, first)) / (2 * actuator.reach)


def _beyond(ends: Interval, actuator: Actuator, unit: str) -> str:
    """Return between which commands something happens, in words."""
    low, high = ends
    if low < high and not abs(low + high) < 0.1 * (high - low):
        return f"below {low:.3g}{unit} or above {high:.3g}{unit}"
    if low < high or actuator.command_range[0] < 0.0 < actuator.command_range[1]:
        return f"beyond {actuator.saturation:.3g}{unit}"
    upper = high > sum(actuator.command_range) / 2
    return f"{'above' if upper else 'below'} {high:.3g}{unit}"


def widened(interval: Interval, settings: Settings) -> Interval:
    """Return the interval that a fault has to exceed.

    >>> widened((-1.0, 1.0), Settings())
    (-1.45, 1.45)
    """
    low, high = interval
    if high - low == float("inf"):
        return interval
    middle, half = 0.5 * (low + high), 0.5 * settings.sure * (high - low)
    return middle - half, middle + half


def outside(interval: Interval) -> bool:
    """Return whether 0 is outside of an interval."""
    return not interval[0] <= 0.0 <= interval[1]


def _when(time: float, step: float) -> str:
    """Return a time since the log began in words.

    >>> _when(2.0, 0.1)
    'step 20 (2 s)'
    """
    return f"step {time / step:.0f}" + (f" ({time:.4g} s)" if step != 1.0 else "")


def _steps(time: float, step: float) -> str:
    """Return a time in steps and, where these are known, seconds.

    >>> _steps(1.04, 1.0), _steps(0.05, 0.02)
    ('1 step', '2.5 steps (0.05 s)')
    """
    text = f"{time / step:.1f}".removesuffix(".0")
    seconds = f" ({time:.2g} s)" if step != 1.0 else ""
    return f"{text} step{'' if text == '1' else 's'}{seconds}"
