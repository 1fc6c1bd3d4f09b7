"""Settings of the quadrotor environment, checked before anything runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from afm_rl.airframe import QuadrotorBody
from afm_rl.envs.references import Circle, Reference, load_reference
from afm_rl.errors import ConfigurationError, check_number
from afm_rl.regimes import Compose, Regime, Schedule, flight_regimes

NAMES = ("action_low", "action_high")
UNIT = 1e-3  # how far a quaternion's length may be from 1


def check_references(
    references: Sequence[Reference | str | Path] | Reference | str | Path | None,
) -> tuple[Reference, ...]:
    """Return the references of a setting, one or several, files or objects; a circle if None.

    Raises:
        ConfigurationError: if there is none, one cannot be used, or two share a name.

    >>> [reference.name for reference in check_references(None)]
    ['circle_2m_0.8mps']
    """
    if references is None:
        references = (Circle(),)
    if isinstance(references, (str, Path)) or not isinstance(references, Iterable):
        references = (references,)
    loaded = tuple(
        load_reference(one) if isinstance(one, (str, Path)) else one for one in references
    )
    for one in loaded:
        if not isinstance(one, Reference):
            raise ConfigurationError(f"references: {one!r}: expected a Reference or a CSV path")
        size = tuple(one.at(torch.zeros(2)).shape)
        if size != (2, 6):
            raise ConfigurationError(
                f"references: {one.name}: at() gives {size} for 2 times, expected (2, 6): position "
                "and velocity"
            )
    names = [one.name for one in loaded]
    if not names or len(set(names)) < len(names):
        raise ConfigurationError(f"references={names}: expected at least one, with distinct names")
    return loaded


def schedule_in_seconds(times: Sequence[float], dt: float = 0.05) -> Schedule:
    """Return a schedule whose phases begin at the first control tick from given times on.

    Args:
        times: increasing times above 0 (s).
        dt: control tick (s).

    Raises:
        ConfigurationError: for times that cannot be used.

    >>> schedule_in_seconds([2.0, 5.0]).at  # phases begin after half a tick before 40 and 100
    (39.5, 99.5)
    """
    return Schedule(ticks(times, dt), by="step")


def ticks(times: Sequence[float], dt: float) -> list[float]:
    """Return breakpoints in steps: half a step before the first one at or after each time.

    Raises:
        ConfigurationError: unless the times are increasing numbers above 0.

    >>> ticks([0.12], dt=0.05)
    [2.5]
    """
    if isinstance(times, str) or not isinstance(times, Sequence):
        raise ConfigurationError(f"times={times!r}: expected a list of times (s)")
    given = [check_number("times", value, low=0.0, open_low=True) for value in times]
    if given != sorted(given):
        raise ConfigurationError(f"times={given}: expected increasing times (s)")
    return [math.ceil(value / dt - 1e-6) - 0.5 for value in given]


def check_flight_schedule(schedule: Schedule | Sequence[float] | None, dt: float) -> Schedule:
    """Return the schedule; a list means times in s, None the published 2 s and 5 s.

    Raises:
        ConfigurationError: if it is neither.

    >>> check_flight_schedule(None, 0.05).phases
    3
    """
    if isinstance(schedule, Schedule):
        return schedule
    return schedule_in_seconds((2.0, 5.0) if schedule is None else schedule, dt)


def check_action_box(
    low: Sequence[float] | None, high: Sequence[float] | None, body: QuadrotorBody
) -> tuple[list[float], list[float]]:
    """Return lowest and highest action; None means what the motors can do.

    Raises:
        ConfigurationError: unless there are four numbers each, low < high.

    >>> check_action_box(None, [0.4, 1e-3, 1e-3, 1e-4], QuadrotorBody())[1]
    [0.4, 0.001, 0.001, 0.0001]
    """
    bounds = []
    for name, given, most in zip(NAMES, (low, high), body.bounds, strict=True):
        values = most if given is None else given
        if isinstance(values, str) or not isinstance(values, Sequence) or len(values) != 4:
            raise ConfigurationError(
                f"{name}={values!r}: expected four numbers, thrust (N) and moments (N m)"
            )
        bounds.append([check_number(name, value) for value in values])
    if any(below >= above for below, above in zip(*bounds, strict=True)):
        raise ConfigurationError(
            f"action_low={bounds[0]}: expected less than action_high={bounds[1]} on each axis"
        )
    return bounds[0], bounds[1]


def check_flight_regime(regime: Regime | None, body: QuadrotorBody) -> Regime:
    """Return the regime family, by default everything in :mod:`afm_rl.regimes.flight`.

    Raises:
        ConfigurationError: if it is no family, or does not fit actions of four components.

    >>> len(check_flight_regime(None, QuadrotorBody()).names)
    16
    """
    if regime is None:
        return flight_regimes(body)
    if not isinstance(regime, Regime):
        raise ConfigurationError(f"regime={regime!r}: expected a Regime")
    try:
        size = regime.apply(torch.zeros(4), regime.encode({}), torch.zeros(13)).shape
    except RuntimeError:
        size = None
    if size != (4,):
        raise ConfigurationError(
            f"regime with parameters {', '.join(regime.names)}: does not fit actions (thrust and "
            "three moments)"
        )
    return regime


def check_parameters(regime: Regime, parameters: Tensor) -> None:
    """Check that parameters ``(*B, F)`` keep the limits of their families.

    Raises:
        ConfigurationError: naming the first parameter that does not.
    """
    families = regime.regimes.values() if isinstance(regime, Compose) else [regime]
    for family in families:
        for name, (low, high) in family.limits.items():
            values = parameters[..., regime.names.index(name)]
            wrong = values[(values < low) | (values > high)]
            if wrong.numel():
                raise ConfigurationError(
                    f"missions: parameters: {name}={wrong[0].item():g}: expected a number in "
                    f"[{low:g}, {high:g}]"
                )


def check_pose(pose: Tensor) -> None:
    """Check states ``(*B, 13)`` from which flights are to go on.

    Raises:
        ConfigurationError: if one is not finite or its quaternion is not of length 1.
    """
    if pose.shape[-1] != 13 or not pose.isfinite().all():
        raise ConfigurationError(
            f"pose {tuple(pose.shape)}: expected 13 finite numbers per flight: position, velocity, "
            "quaternion (scalar-last), body rate"
        )
    length = pose[..., 6:10].norm(dim=-1).reshape(-1)
    rows = (length - 1).abs().gt(UNIT).nonzero().flatten().tolist()
    if rows:
        raise ConfigurationError(
            f"pose: quaternions of flights {rows}: length {length[rows[0]].item():g}, expected 1"
        )


def check_steps(duration: float, dt: float) -> int:
    """Return the number of control ticks in a flight.

    Raises:
        ConfigurationError: unless the duration (s) is a whole number of ticks.

    >>> check_steps(8.0, 0.05)
    160
    """
    duration = check_number("duration", duration, low=0.0, open_low=True)
    steps = round(duration / dt)
    if steps < 1 or abs(steps * dt - duration) > 1e-6 * duration:
        raise ConfigurationError(f"duration={duration!r}: expected a multiple of dt={dt!r} s")
    return steps


def check_sensor_noise(std: float | Sequence[float]) -> Tensor:
    """Return standard deviations ``(12,)`` of the observed state's tangent coordinates.

    Args:
        std: one number, or four: position (m), velocity (m/s), attitude (rad), rate (rad/s).

    Raises:
        ConfigurationError: for anything else.

    >>> check_sensor_noise([0.5, 0, 0, 0])[:4]
    tensor([0.5000, 0.5000, 0.5000, 0.0000], dtype=torch.float64)
    """
    given = list(std) if isinstance(std, Sequence) and not isinstance(std, str) else [std] * 4
    if len(given) != 4:
        raise ConfigurationError(f"sensor_noise={std!r}: expected one number, or four")
    checked = [check_number("sensor_noise", value, low=0.0) for value in given]
    return torch.tensor(checked, dtype=torch.float64).repeat_interleave(3)
