"""What other tools take of a calibration: lines of their configurations, by documented names."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from afm_rl.diagnosis.calibration import Calibration, JointCalibration
from afm_rl.errors import ConfigurationError, check_choice, check_number, printable

AXES = ("vx", "vy", "wz")


class Joint(NamedTuple):
    """What differs from a healthy joint, which has the gain 1 and else zeros."""

    name: str
    gain: float
    offset: float
    """In units of the command."""
    delay: float
    """Beyond that of the healthy robot (s)."""
    earliest: float
    latest: float
    """Ends of the 95 % interval of the delay (s)."""
    lag: float
    """Time constant (s)."""
    limits: tuple[float, float]
    """Commands beyond which nothing more happens."""


class Tool(NamedTuple):
    """A tool, and what its configuration can express of a joint."""

    takes: str
    """What the lines are, with the version whose documented names they use."""
    lines: Callable[[Sequence[Joint], float], list[str]]
    """Of joints, and the unit of the tool."""
    fields: tuple[str, ...]
    """Numbers of a :class:`~afm_rl.diagnosis.calibration.JointCalibration` that they express."""
    option: str = ""
    """Which option gives the unit."""


class Answer(NamedTuple):
    """What a tool takes of a calibration."""

    title: str
    lines: list[str]
    remarks: list[str]
    """What it has no field for, and what the log leaves open."""

    def __str__(self) -> str:
        return "\n".join([f"{self.title}:", *self.lines, *self.remarks])


def unit_of(tool: str, step: float | None = None, tick: float | None = None) -> float:
    """Return the unit of a tool, one of the two; 1 if it needs none.

    Raises:
        ConfigurationError: for another tool, or without the option that it needs.
    """
    option = TOOLS[check_choice("--for", tool, TOOLS)].option
    unit = {"step": step, "tick": tick}.get(option, 1.0)
    if unit is None:
        raise ConfigurationError(f"--for {tool}: expected --{option}, {OPTIONS[option]}")
    return check_number(f"--{option}", unit, low=0.0, open_low=True)


def answer(
    tool: str, calibration: Calibration, step: float | None = None, tick: float | None = None
) -> Answer:
    """Return what a tool takes of a calibration.

    Args:
        tool: one of :data:`TOOLS`.
        calibration: of the robot.
        step: physics step of a simulator (s): its control step divided by its decimation.
        tick: step of an encoder, in units of the response.

    Raises:
        ConfigurationError: as :func:`unit_of`, or if it needs seconds and the log has none.

    >>> import numpy as np
    >>> from afm_rl.diagnosis import Log, calibrate
    >>> u = np.random.default_rng(0).uniform(-1, 1, (300, 1))
    >>> late = Log(("wz",), u[3:], u[:-3], t=0.1 * np.arange(297))
    >>> answer("nav2", calibrate(late)).lines
    ['model_delay_wz: 0.300']
    """
    unit, about = unit_of(tool, step, tick), TOOLS[tool]
    if "delay" in about.fields and calibration.time != "s":
        raise ConfigurationError(
            f"--for {tool}: the log has no time, so its delays are in rows: expected a column t (s)"
        )
    joints = [joint for joint in calibration.joints if joint.usable]
    remarks: dict[str, list[tuple[str, str]]] = {
        f"{tool} has no field for": [
            (field, f"{joint.name} {text}")
            for joint in joints
            for field, text in _faults(joint, calibration).items()
            if field not in about.fields
        ],
        "not well determined one by one": [
            (field, joint.name)
            for joint in joints
            for field in about.fields
            if not getattr(getattr(joint, field), "determined", True)
        ],
        "no lines for": [(x.status, x.name) for x in calibration.joints if not x.usable],
    }
    return Answer(
        about.takes,
        about.lines([_joint(joint, calibration) for joint in joints], unit),
        [f"{begin}: {_listed(pairs)}" for begin, pairs in remarks.items() if pairs],
    )


def _joint(joint: JointCalibration, calibration: Calibration) -> Joint:
    gain, offset, _ = joint.matters
    usual, (low, high) = calibration.usual_delay, joint.delay.interval
    return Joint(
        name=printable(joint.name),
        gain=gain / joint.unit,
        offset=offset / joint.unit,
        delay=max(joint.delay.value - usual, 0.0),
        earliest=max(low - usual, 0.0),
        latest=max(high - usual, 0.0),
        lag=joint.lag.value if joint.lag.interval[0] > 0.0 else 0.0,
        limits=joint.limits,
    )


def _faults(joint: JointCalibration, calibration: Calibration) -> dict[str, str]:
    """Return the numbers that are not those of a healthy joint, as text."""
    gain, offset, zone = joint.matters
    low, high = joint.limits
    found = {
        "sign": (gain < 0.0, "-1"),
        "scale": (abs(gain) != joint.unit, f"{abs(gain):.3g}"),
        "offset": (offset != 0.0, f"{offset:.3g}"),
        "dead_zone": (zone != 0.0, f"{zone:.3g}"),
        "delay": (
            joint.delay.interval[0] > calibration.usual_delay,
            f"{joint.delay.value:.3g} {calibration.time}",
        ),
        "lag": (joint.lag.interval[0] > 0.0, f"{joint.lag.value:.3g} {calibration.time}"),
        "rate": (math.isfinite(joint.rate.value), f"{joint.rate.value:.3g}"),
        "limits": (math.isfinite(low) or math.isfinite(high), f"{low:.3g} to {high:.3g}"),
        "follows": (joint.follows != joint.name, joint.follows),
        "coupling": (bool(joint.coupling), f"with {', '.join(joint.coupling)}"),
    }
    return {field: text for field, (there, text) in found.items() if there}


def _listed(pairs: Sequence[tuple[str, str]]) -> str:
    """Return items by their kinds.

    >>> _listed([("delay", "left"), ("dead_zone", "left"), ("delay", "right")])
    'delay (left, right), dead zone (left)'
    """
    kinds = dict.fromkeys(kind for kind, _ in pairs)
    items = {kind: ", ".join(item for of, item in pairs if of == kind) for kind in kinds}
    texts = (f"{kind.replace('_', ' ')} ({listed})" for kind, listed in items.items())
    return printable(", ".join(texts), 2000)


def _mjlab(joints: Sequence[Joint], step: float) -> list[str]:
    return _lags("target_names_expr={}, delay_min_lag={}, delay_max_lag={},", joints, step)


def _isaaclab(joints: Sequence[Joint], step: float) -> list[str]:
    return _lags("joint_names_expr={}, min_delay={}, max_delay={},", joints, step)


def _lags(line: str, joints: Sequence[Joint], step: float) -> list[str]:
    """Return a line for all joints of the same delays, in whole steps of the simulator."""
    groups: dict[tuple[int, int], list[str]] = {}
    for joint in joints:
        if math.isfinite(joint.latest):
            ends = math.floor(joint.earliest / step + 1e-6), math.ceil(joint.latest / step - 1e-6)
            groups.setdefault(ends, []).append(re.escape(joint.name))
    return [line.format(tuple(names), *ends) for ends, names in groups.items()]


def _nav2(joints: Sequence[Joint], _: float) -> list[str]:
    """Return the delays of axes; wheels act on all axes."""
    late = {joint.name: joint.delay + joint.lag for joint in joints}
    named = [axis for axis in AXES if axis in late]
    wheels = dict.fromkeys(
        [] if named or not late else AXES, sum(late.values()) / max(len(late), 1)
    )
    return [f"model_delay_{axis}: {(wheels | late)[axis]:.3f}" for axis in named or wheels]


def _lerobot(joints: Sequence[Joint], tick: float) -> list[str]:
    motors = {
        joint.name: {"drive_mode": int(joint.gain < 0), "homing_offset": round(joint.offset / tick)}
        for joint in joints
    }
    return [f"{json.dumps(name)}: {json.dumps(motor)}," for name, motor in motors.items()]


def _mujoco(joints: Sequence[Joint], step: float) -> list[str]:
    lines = []
    for joint in joints:
        line = f"<general name={quoteattr(joint.name)} gear="
        line += f'"{joint.gain:.4g}"'
        if joint.offset:
            line += f' biastype="affine" biasprm="{joint.offset / joint.gain:.4g} 0 0"'
        if joint.delay > 0.5 * step:
            line += f' delay="{joint.delay:.4g}" nsample="{math.ceil(joint.delay / step) + 1}"'
        if math.inf not in (-joint.limits[0], joint.limits[1]):
            line += ' ctrlrange="{:.4g} {:.4g}"'.format(*joint.limits)
        if joint.lag:
            line += f' dyntype="filterexact" dynprm="{joint.lag:.4g}"'
        lines.append(f"{line}/>")
    return lines


OPTIONS = {
    "step": "the physics step of the simulator (s), its control step divided by its decimation, "
    "such as 0.005",
    "tick": "the step of an encoder in units of the response, such as 0.0879 (360 / 4095 degrees)",
}
TOOLS = {
    "mjlab": Tool(
        "mjlab 1.6: arguments of an actuator's configuration", _mjlab, ("delay",), "step"
    ),
    "isaaclab": Tool(
        "Isaac Lab 2.3: arguments of DelayedPDActuatorCfg", _isaaclab, ("delay",), "step"
    ),
    "nav2": Tool("Nav2 Lyrical: parameters of the MPPI controller", _nav2, ("delay", "lag")),
    "lerobot": Tool(
        "LeRobot 0.6: changes of a calibration file", _lerobot, ("sign", "offset"), "tick"
    ),
    "mujoco": Tool(
        "MuJoCo 3.17: attributes of actuators of gear 1",
        _mujoco,
        ("sign", "scale", "offset", "delay", "lag", "limits"),
        "step",
    ),
}
