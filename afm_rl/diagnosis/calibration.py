"""A diagnosis that can be written back: numbers per joint, and commands that make up for them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from afm_rl.diagnosis.findings import Actuator, Diagnosis, Interval, Status, plain, shifted
from afm_rl.diagnosis.intervals import half_widths
from afm_rl.diagnosis.log import Clock, Log, clocks_of
from afm_rl.diagnosis.model import cut
from afm_rl.diagnosis.response import Shape, keep_of, lagging, respond, shaped
from afm_rl.diagnosis.scale import unwrapped
from afm_rl.diagnosis.settings import Settings
from afm_rl.diagnosis.verdict import diagnose
from afm_rl.errors import ConfigurationError, printable, refusing
from afm_rl.storage.files import write_whole

if TYPE_CHECKING:
    from afm_rl.dynamics import KnownDynamics


class Estimate(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    interval: Interval
    determined: bool
    """Is the interval narrower, to either side, than a quarter of the number, or than matters?"""


@dataclass(frozen=True, kw_only=True)
class JointCalibration:
    r"""How the response of a joint follows a command, in the units of the log.

    .. math:: y = L_\tau[\mathrm{sign} \cdot \mathrm{scale} \cdot z(u(t - d))] + \mathrm{offset}

    with the dead zone z and the lag L; y changes by at most ``rate`` per unit of time.
    """

    name: str
    status: Status
    follows: str
    """Whose command it follows."""
    sign: Estimate
    scale: Estimate
    offset: Estimate
    """The response at command 0."""
    dead_zone: Estimate
    delay: Estimate
    lag: Estimate
    rate: Estimate
    """Infinite if no limit was seen; then its interval begins at the largest change."""
    unit: float = 1.0
    """Scale of a healthy joint: 1, or that of two units."""
    scale_down: float | None = None
    """Scale of negative commands, where it is another one."""
    coupling: Mapping[str, float] = field(default_factory=dict)
    """Response per command of other joints."""
    limits: Interval = (-math.inf, math.inf)
    """Commands beyond which nothing more happens."""
    noise: float = 0.0
    """Standard deviation of what is left, in units of the response."""
    undo: str = ""
    """The command that has the effect of a command u on a healthy joint, in words."""

    @property
    def usable(self) -> bool:
        """Is enough known to make up for it?"""
        return self.sign.determined and self.scale.determined

    @property
    def matters(self) -> tuple[float, float, float]:
        """Gain, offset and dead zone as far as their intervals say that they are not healthy."""
        low, high = self.scale.interval
        gain = self.sign.value * (self.unit if low <= self.unit <= high else self.scale.value)
        low, high = self.offset.interval
        zone = self.dead_zone.value if self.dead_zone.interval[0] > 0.0 else 0.0
        return gain, 0.0 if low <= 0.0 <= high else self.offset.value, zone

    @property
    def supposed(self) -> JointCalibration:
        """The joint itself, or, where nothing is known of it, a healthy one."""
        if self.status in ("healthy", "changed", "dead") and math.isfinite(self.offset.value):
            return self
        healthy = {"sign": 1.0, "scale": self.unit, "offset": 0.0, "dead_zone": 0.0}
        healthy |= {"delay": 0.0, "lag": 0.0, "rate": math.inf}
        numbers: Any = {n: getattr(self, n)._replace(value=value) for n, value in healthy.items()}
        return replace(self, follows=self.name, scale_down=None, coupling={}, **numbers)

    @property
    def gains(self) -> tuple[float, float]:
        """Response per positive, and per negative command."""
        down = self.scale.value if self.scale_down is None else self.scale_down
        return self.sign.value * self.scale.value, self.sign.value * down


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """What is known of all joints of a robot.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (300, 1))
    >>> (elbow,) = calibrate(Log(("elbow",), u, 0.2 - 0.5 * u)).joints
    >>> elbow.sign.value, round(elbow.scale.value, 2), elbow.offset.determined, elbow.undo
    (-1.0, 0.5, True, '(u - 0.2) / -0.5')
    """

    joints: tuple[JointCalibration, ...]
    step: float
    """Time between two rows."""
    usual_delay: float = 0.0
    """Delay of a healthy robot."""
    time: str = "s"
    """Unit of all times: s, or rows."""
    units: tuple[str, str] = ("", "")
    """Of commands and responses, as text; empty if they are not known."""

    @property
    def delay_steps(self) -> list[int]:
        """Whole steps by which each joint is later than a healthy one, as corrections take them."""
        delays = ((joint.delay.value - self.usual_delay) / self.step for joint in self.joints)
        return [max(round(steps), 0) for steps in delays]

    VERSION: ClassVar[int] = 1

    def write(self, path: str | Path) -> None:
        """Write a JSON file, which :func:`read_calibration` reads."""
        content = plain({"version": self.VERSION} | asdict(self))
        text = json.dumps(content, indent=2, ensure_ascii=False)
        write_whole(Path(path), text.encode())


def read_calibration(path: str | Path) -> Calibration:
    """Read what :meth:`Calibration.write` wrote.

    Raises:
        ConfigurationError: for anything else.
    """
    expected = "no calibration, or a damaged one; expected a file of afm-rl-diagnose --calibration"
    with refusing(f"{path}: {expected}"):
        with Path(path).open(encoding="utf-8") as file:
            content = json.loads(file.read(1 << 24))
        if content.pop("version") != Calibration.VERSION:
            raise ValueError(f"version is not {Calibration.VERSION}")
        joints = tuple(_joint(part) for part in content.pop("joints"))
        content |= {name: float(content[name]) for name in ("step", "usual_delay")}
        return Calibration(joints=joints, **content | {"units": tuple(content["units"])})


def _joint(part: dict[str, Any]) -> JointCalibration:
    for name in ("sign", "scale", "offset", "dead_zone", "delay", "lag", "rate"):
        value, interval, determined = part[name].values()
        if value is None:
            value = math.inf if name == "rate" else math.nan
        part[name] = Estimate(float(value), _ends(interval), bool(determined))
    return JointCalibration(**part | {"limits": _ends(part["limits"])})


def _ends(pair: Any) -> Interval:
    low, high = pair
    return (-math.inf if low is None else float(low), math.inf if high is None else float(high))


def calibrate(
    log: Log, diagnosis: Diagnosis | None = None, settings: Settings | None = None
) -> Calibration:
    """Return the numbers of each joint with their intervals, those after its last change.

    Args:
        log: what the robot logged.
        diagnosis: of this log, if it is known.
        settings: by which it was made.
    """
    settings = settings or Settings()
    diagnosis = diagnosis or diagnose(log, settings)
    if any(actuator.turn for actuator in diagnosis.actuators):
        log, _ = unwrapped(log, settings)
    joints = [_calibrated(log, j, a, settings) for j, a in enumerate(diagnosis.actuators)]
    found = Calibration(
        joints=tuple(joints),
        step=log.step,
        usual_delay=log.usual_delay,
        time="s" if log.step != 1.0 else "rows",
        units=log.units,
    )
    return replace(found, joints=tuple(replace(x, undo=_in_words(x, found)) for x in found.joints))


def _calibrated(log: Log, j: int, a: Actuator, s: Settings) -> JointCalibration:
    """Return the numbers of one joint."""
    since, _ = a.pieces[-1]
    log = log.part(log.since >= since).thinned(s.refined)
    known = a.status in ("healthy", "changed") and math.isfinite(a.gain)
    clear = known and a.signed
    sign = math.copysign(1.0, a.gain)
    ends = {"scale": tuple(sorted(sign * end for end in a.gain_interval))}
    at_zero = (a.unit - a.gain) * a.centre  # offsets are those from a healthy response at centre
    slack = abs(a.centre) * 0.5 * (a.gain_interval[1] - a.gain_interval[0]) if a.centre else 0.0
    low, high = shifted(a.offset_interval, at_zero)
    ends["offset"] = low - slack, high + slack
    values = {"scale": abs(a.gain), "offset": a.offset + at_zero, "dead_zone": a.dead_zone}
    values |= {"delay": a.delay_s, "lag": a.lag_s, "rate": math.inf if a.rate is None else a.rate}
    unknown = (-math.inf, math.inf)
    numbers: Any = {name: Estimate(value, unknown, False) for name, value in values.items()}
    joint = JointCalibration(
        name=a.name,
        status=a.status,
        follows=a.name if a.driven_by in (None, *a.coupling) else str(a.driven_by),
        sign=Estimate(sign, (sign, sign) if clear else (-1.0, 1.0), clear),
        **numbers,
        unit=a.unit,
        scale_down=None if a.gain_down is None else abs(a.gain_down),
        coupling=dict(a.coupling),
        limits=a.followed,
        noise=a.noise if math.isfinite(a.noise) else 0.0,
    )
    if known:
        ends = _other_intervals(log, j, joint) | ends
        latest = max(a.time_interval[1], 0.0)  # of both together
        for name in ("delay", "lag"):
            low, high = ends[name]
            ends[name] = (min(low, values[name]), max(min(high, latest), values[name]))
    late, small = s.late * log.step, s.matters * a.reach
    matters = {"scale": s.matters * a.unit, "offset": a.unit * small, "dead_zone": small}
    matters |= {"delay": late, "lag": late, "rate": 0.0}
    estimates: dict[str, Any] = {}
    for name, (low, high) in ends.items():
        low = low if name == "offset" or values[name] < 0.0 else max(low, 0.0)
        width = max(values[name] - low, high - values[name])
        narrow = known and width <= max(s.vague * abs(values[name]), matters[name]) < math.inf
        estimates[name] = Estimate(float(values[name]), (float(low), float(high)), bool(narrow))
    return replace(joint, **estimates)


def _other_intervals(log: Log, j: int, joint: JointCalibration) -> dict[str, Interval]:
    """Return the 95 % intervals of dead zone, delay, lag and rate, by the fit's derivatives."""
    y, clock = log.response[:, j], _clock_of(log, j, joint)
    here = _response(log, clock, joint)
    steps = {"scale": 0.01, "offset": 0.01 * max(float(y.std()), 1e-9), "lag": 0.5 * log.step}
    steps |= {"dead_zone": 0.005 * max(float(np.ptp(log.command)), 1e-9), "delay": 0.05 * log.step}
    steps |= {"rate": 0.02 * joint.rate.value} if joint.rate.value < math.inf else {}
    columns = []
    for name, step in steps.items():
        estimate = getattr(joint, name)
        beside = replace(joint, **{name: estimate._replace(value=estimate.value + step)})
        columns.append((_response(log, clock, beside) - here) / step)
    waiting = (max(joint.delay.value, 0.0) + 5 * joint.lag.value) / log.step
    use = np.arange(len(y)) - clock.start >= min(waiting, 0.2 * len(y) / log.begins.sum())
    slopes = np.column_stack(columns)[use]
    size = np.sqrt((slopes**2).sum(0))
    blind = size <= 1e-12 * size.max()  # nothing depends on these
    unit = slopes / np.where(blind, 1.0, size)
    inverse = np.linalg.pinv(unit.T @ unit, rcond=1e-10, hermitian=True)
    widths = half_widths(cut((y - here)[use])[:, None] * (unit @ inverse)) / size.clip(1e-300)
    widths[blind] = math.inf
    fastest = float(np.quantile(np.abs(np.diff(here))[~log.begins[1:]], 0.999)) / log.step
    return {"rate": (fastest, math.inf)} | {
        name: (getattr(joint, name).value - width, getattr(joint, name).value + width)
        for name, width in zip(steps, widths, strict=True)
    }


def _clock_of(log: Log, j: int, joint: JointCalibration) -> Clock:
    """Return the clock by which a joint is predicted best."""
    y = log.response[:, j]
    return min(clocks_of(log), key=lambda clock: np.abs(y - _response(log, clock, joint)).sum())


def _response(log: Log, clock: Clock, joint: JointCalibration) -> np.ndarray:
    """Return the response of a joint to the commands of a log, ``(N,)``."""
    shape = Shape(
        delay=joint.delay.value / log.step,
        keep=keep_of(joint.lag.value / log.step),
        dead_zone=joint.dead_zone.value,
        low=joint.limits[0],
        high=joint.limits[1],
        rate=joint.rate.value * log.step / max(joint.scale.value, 1e-300),
    )
    column = dict(zip(log.names, log.command.T, strict=True))
    drive, (up, down) = shaped(clock, column[joint.follows], shape), joint.gains
    drive = np.where(drive < 0, down, up) * drive
    response = joint.offset.value + lagging(clock, drive, shape.keep)
    for name, gain in joint.coupling.items():
        response = response + gain * respond(clock, column[name], shape.linear)
    return response


def predict(calibration: Calibration, log: Log) -> np.ndarray:
    """Return the responses to the commands of a log, ``(N, A)``, of joints in the log's order.

    Joints of which nothing is known count as healthy.
    """
    pairs = enumerate(joint.supposed for joint in calibration.joints)
    responses = [_response(log, _clock_of(log, j, joint), joint) for j, joint in pairs]
    return np.column_stack(responses)


def apply(calibration: Calibration, command: Any, ahead: bool = False) -> np.ndarray:
    r"""Return the commands that have the effect of the given ones on a healthy robot.

    .. math:: u' = z^{-1}(M^{-1} (\mathrm{unit} \odot u - \mathrm{offset}))

    with M the gains of all commands on all joints, and :math:`z^{-1}` the dead zone, added. What
    may be healthy, by its interval, is not made up for; and where a joint's sign or scale is not
    determined, its command stays.

    Args:
        calibration: of the robot.
        command: what the joints should do, ``(*B, A)``.
        ahead: the commands are those of a whole way, a row per step, ``(N, A)``: they are sent
            ahead by what joints are later than healthy ones, and by their lags.

    Raises:
        ConfigurationError: for commands of another shape, or if two joints follow the same command,
            so that no commands have this effect.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (300, 1))
    >>> calibration = calibrate(Log(("elbow",), u, 0.2 - 0.5 * u))
    >>> apply(calibration, [0.1]).round(3)
    array([0.2])
    """
    joints, size = calibration.joints, len(calibration.joints)
    target = np.array(command, dtype=float)
    if target.shape[-1:] != (size,) or (ahead and target.ndim != 2):
        raise ConfigurationError(
            f"apply: commands {target.shape}: expected {'rows' if ahead else '(...,'} of {size} "
            f"numbers, one per joint"
        )
    names = [joint.name for joint in joints]
    gains, zones = np.diag([joint.unit for joint in joints]), np.zeros(size)
    offset, down = np.zeros(size), np.ones(size)
    target = target * gains.diagonal()
    for j, joint in enumerate(joints):
        if not joint.usable:
            continue
        if ahead:
            target[:, j] = _ahead(target[:, j], joint, calibration)
        driver = names.index(joint.follows)
        gains[j] = [joint.coupling.get(name, 0.0) for name in names]
        gains[j, driver], offset[j], zones[driver] = joint.matters
        down[driver] = joint.scale.value / (joint.scale_down or joint.scale.value)
    if np.linalg.cond(gains) > 1e6:
        followed = [joint.follows for joint in joints]
        raise ConfigurationError(
            f"apply: joints follow the commands of {printable(', '.join(followed), 300)}: expected "
            "a command for each joint, because coupled joints cannot be undone"
        )
    inner = np.linalg.solve(gains, (target - offset)[..., None])[..., 0]
    return np.where(inner < 0, inner * down, inner) + np.sign(inner) * zones


def _ahead(target: np.ndarray, joint: JointCalibration, calibration: Calibration) -> np.ndarray:
    """Return what a joint must be sent in each step to be at a target ``(N,)``."""
    keep = keep_of(joint.lag.value / calibration.step)
    rows = np.arange(len(target))
    before = np.concatenate([target[:1], target[:-1]])
    late = (joint.delay.value - calibration.usual_delay) / calibration.step
    return np.interp(rows + max(late, 0.0), rows, (target - keep * before) / (1 - keep))


def known_dynamics(calibration: Calibration) -> KnownDynamics:
    r"""Return a model of the calibrated robot: its state is its response, ``(*B, A)``.

    .. math:: y' = y + \mathrm{clip}((1 - e^{-\Delta/\tau})(g z(u) + b - y), \pm R \Delta)

    Delays are no part of it: give them to a correction by ``delay=calibration.delay_steps``.
    Joints of which nothing is known count as healthy.

    >>> u = np.random.default_rng(0).uniform(-1, 1, (300, 1))
    >>> model = known_dynamics(calibrate(Log(("elbow",), u, 0.2 - 0.5 * u)))
    >>> import torch
    >>> model(torch.zeros(1), torch.tensor([0.4])).round(decimals=3)
    tensor([0.])
    """
    import torch

    from afm_rl.dynamics import KnownDynamics
    from afm_rl.spaces.manifold import Manifold

    joints, step = [joint.supposed for joint in calibration.joints], calibration.step
    names = [joint.name for joint in joints]
    drivers = [names.index(joint.follows) for joint in joints]
    coupling = [[joint.coupling.get(name, 0.0) for name in names] for joint in joints]
    table = [
        (*joint.limits, joint.dead_zone.value, *joint.gains, joint.offset.value)
        + (1 - keep_of(joint.lag.value / step), joint.rate.value * step)
        for joint in joints
    ]
    numbers, others = (torch.tensor(x, dtype=torch.float64).mT for x in (table, coupling))

    def advance(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        low, high, zone, up, down, offset, share, most = numbers.to(action)
        command = action[..., drivers].clamp(low, high)
        command = command - command.clamp(-zone, zone)
        drive = command.clamp(min=0) * up + command.clamp(max=0) * down
        drive = drive + action @ others.to(action) + offset
        return state + (share * (drive - state)).clamp(-most, most)

    noise = [max(joint.noise, 1e-6) for joint in joints]
    return KnownDynamics(advance, Manifold(len(joints)), len(joints), noise_std=noise)


def _in_words(joint: JointCalibration, calibration: Calibration) -> str:
    """Return the command that has the effect of u on a healthy joint."""
    if not joint.usable:
        return f"nothing: {joint.status}"
    gain, offset, zone = joint.matters
    same = gain == joint.unit and not offset
    text = "u" if same or joint.unit == 1.0 else f"{joint.unit:.6g} * u"
    if offset:
        text = f"({text} {'-' if offset > 0 else '+'} {abs(offset):.6g})"
    if not same and gain != 1.0:
        text = f"-{text}" if gain == -1.0 else f"{text} / {gain:.6g}"
    if zone:
        text += f", and {zone:.6g} more in its direction"
    if joint.follows != joint.name:
        text += f", as the command of {joint.follows}"
    if joint.coupling:
        text += f", less what the commands of {', '.join(joint.coupling)} do"
    late = joint.delay.value - calibration.usual_delay
    if late > 0.5 * calibration.step:
        text += f", {late:.3g} {calibration.time} earlier"
    if joint.scale_down is not None:
        text += f"; negative ones by {joint.scale_down:.6g}"
    return text
