"""The quadrotor's environment as missions from configuration want it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from afm_rl.envs.quadrotor import CrazyflieTrack
from afm_rl.envs.references import Circle, FigureEight, Hover, Reference, load_reference
from afm_rl.errors import ConfigurationError, check_count, check_number
from afm_rl.regimes import Regime, Schedule

NUMBER = r"(\d+(?:\.\d+)?)"
NAMED: dict[str, Callable[..., Reference]] = {
    "hover": Hover,
    f"circle_{NUMBER}m_{NUMBER}mps": Circle,
    f"figure_8_{NUMBER}s": lambda period: FigureEight(period=period),
}


def find_reference(name: str) -> Reference:
    """Return a reference by its name, or from a CSV file.

    Args:
        name: ``hover``, ``circle_2m_0.8mps`` (radius, speed), ``figure_8_8s`` (period), or the path
            of a CSV file; see :func:`~afm_rl.envs.references.load_reference`.

    Raises:
        ConfigurationError: if there is no such reference, or the file cannot be used.

    >>> find_reference("circle_3m_1.2mps").speed
    1.2
    """
    for pattern, make in NAMED.items():
        found = re.fullmatch(pattern, name)
        if found:
            return make(*map(float, found.groups()))
    if not name.lower().endswith(".csv"):
        raise ConfigurationError(
            f"tracks={name!r}: expected hover, a circle such as circle_2m_0.8mps (radius, speed), "
            "a figure of eight such as figure_8_8s (period), or the path of a CSV file"
        )
    return load_reference(name)


def make_flights(
    tracks: Sequence[str],
    regime: Regime,
    schedule: Schedule,
    max_steps: int,
    duration: float = 8.0,
    dt: float = 0.05,
    preview: bool = True,
    start: str | None = None,
    **settings: Any,
) -> CrazyflieTrack:
    """Return an environment whose tracks are references, by name.

    Args:
        tracks: see :func:`find_reference`.
        regime: regime family.
        schedule: when regimes change.
        max_steps: control ticks after which a flight is over, unless ``duration`` is less.
        duration: length of a flight (s).
        dt: control tick (s).
        preview: whether planners see the reference's future.
        start: ``"moving"`` or ``"rest"``; None: moving with preview, and at rest without, as in
            the published flights.
        settings: further arguments of :class:`~afm_rl.envs.CrazyflieTrack`.

    Raises:
        ConfigurationError: for a setting that cannot be used.

    >>> from afm_rl.regimes import MassFactor
    >>> env = make_flights(["hover"], MassFactor(), Schedule([], by="step"), max_steps=5)
    >>> env.simulation.steps
    5
    """
    duration = check_number("duration", duration, low=0.0, open_low=True)
    dt = check_number("dt", dt, low=0.0, open_low=True)
    return CrazyflieTrack(
        [find_reference(name) for name in tracks],
        regime,
        schedule,
        duration=min(duration, check_count("max_steps", max_steps) * dt),
        dt=dt,
        preview=preview,
        start=("moving" if preview else "rest") if start is None else start,
        **settings,
    )
