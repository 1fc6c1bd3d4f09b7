"""Reference flights: where to be, and how fast, at any time."""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from afm_rl.envs.courses.track import check_near, local_origin, read_columns
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.options import NonNegative, Positive, options


class Reference(ABC):
    """Position and velocity over time.

    References made of points that are far from zero are moved by whole kilometres, so that single
    precision does: see :func:`~afm_rl.envs.courses.track.local_origin`.

    Attributes:
        name: how missions call it.
    """

    name: str

    @abstractmethod
    def at(self, time: Tensor) -> Tensor:
        """Return position (m) and velocity (m/s) ``(*B, 6)`` at times (s) ``(*B)``."""


def check_reference(reference: Reference) -> Reference:
    """Return a reference if it gives positions and velocities."""
    size = tuple(check_instance("tracks", reference, Reference).at(torch.zeros(2)).shape)
    if size != (2, 6):
        raise ConfigurationError(
            f"tracks: {reference.name}: at() gives {size} for 2 times, expected (2, 6): position "
            "and velocity"
        )
    return reference


def references_at(references: Sequence[Reference], index: Tensor, time: Tensor) -> Tensor:
    """Return ``(*B, K, 6)`` of references by index ``(*B)`` at times ``(*B, K)``.

    >>> from afm_rl.envs import Circle, Hover
    >>> flights = torch.tensor([0, 1])
    >>> references_at([Hover(), Circle(1.0, 0.0)], flights, torch.zeros(2, 3))[..., 0]
    tensor([[0., 0., 0.],
            [1., 1., 1.]])
    """
    if len(references) == 1:
        return references[0].at(time)
    every = torch.stack([reference.at(time) for reference in references])
    chosen = index[None, ..., None, None].expand(1, *every.shape[1:])
    return every.gather(0, chosen).squeeze(0)


class SampledReference(Reference):
    """Positions and velocities at given times, linear in between and constant outside.

    Args:
        times: increasing times (s), N of them, at least two.
        positions: ``(N, 3)`` in m.
        velocities: ``(N, 3)`` in m/s.
        name: how missions call it.

    Raises:
        ConfigurationError: for numbers that do not go together.

    >>> rows = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]])
    >>> SampledReference(torch.tensor([0.0, 2.0]), rows, rows).at(torch.tensor(1.0))
    tensor([0.5000, 0.0000, 0.0000, 0.5000, 0.0000, 0.0000])
    """

    def __init__(
        self, times: Tensor, positions: Tensor, velocities: Tensor, name: str = "table"
    ) -> None:
        self.name = name
        sizes = {positions.shape, velocities.shape}
        if len(times) < 2 or sizes != {(len(times), 3)}:
            raise ConfigurationError(
                f"references: {name}: {len(times)} times, positions {tuple(positions.shape)} and "
                f"velocities {tuple(velocities.shape)}: expected N >= 2 times and (N, 3) each"
            )
        if not times.diff().gt(0).all():
            raise ConfigurationError(f"references: {name}: expected times that increase")
        check_near(positions, f"{name}: position")
        local = positions - local_origin(positions)
        self.times, self.rows = times, torch.cat([local, velocities], -1)

    def at(self, time: Tensor) -> Tensor:
        times, rows = self.times.to(time), self.rows.to(time)
        inside = time.clamp(times[0], times[-1])
        last = torch.searchsorted(times, inside.contiguous(), right=True).clamp(1, len(times) - 1)
        share = (inside - times[last - 1]) / (times[last] - times[last - 1])
        return torch.lerp(rows[last - 1], rows[last], share.unsqueeze(-1))


def load_reference(path: str | Path) -> SampledReference:
    """Read a reference from a CSV file with the columns t,x,y,z,vx,vy,vz (s, m, m/s).

    It is called like the file.

    Raises:
        ConfigurationError: if the file cannot be used.

    >>> load_reference("flight.csv")
    Traceback (most recent call last):
    afm_rl.errors.ConfigurationError: tracks: cannot read flight.csv: No such file or directory
    """
    path = Path(path)
    _, rows = read_columns(path, [("t", "x", "y", "z", "vx", "vy", "vz")])
    return SampledReference(rows[:, 0], rows[:, 1:4], rows[:, 4:], path.stem)


class Hover(Reference):
    """Standing still at the origin.

    >>> Hover().at(torch.tensor(2.0))
    tensor([0., 0., 0., 0., 0., 0.])
    """

    name = "hover"

    def at(self, time: Tensor) -> Tensor:
        return time.new_zeros(*time.shape, 6)


class Circle(Reference):
    r"""A level circle about the origin at constant speed.

    .. math:: r = R (\cos \varphi, \sin \varphi, 0),\quad \varphi = v t / R

    >>> Circle(radius=2.0, speed=0.5).at(torch.zeros(()))
    tensor([2.0000, 0.0000, 0.0000, -0.0000, 0.5000, 0.0000])
    """

    @options("circle")
    def __init__(
        self,
        radius: Annotated[Positive, "R, m"] = 2.0,
        speed: Annotated[NonNegative, "v, m/s"] = 0.8,
    ) -> None:
        self.radius, self.speed = radius, speed
        self.name = f"circle_{self.radius:g}m_{self.speed:g}mps"

    def at(self, time: Tensor) -> Tensor:
        angle = time * (self.speed / self.radius)
        cos, sin, none = angle.cos(), angle.sin(), torch.zeros_like(angle)
        here = torch.stack([cos, sin, none], -1) * self.radius
        return torch.cat([here, torch.stack([-sin, cos, none], -1) * self.speed], -1)


class FigureEight(Reference):
    r"""A level figure of eight, which starts in its centre.

    .. math:: r = (a \sin \varphi, b \sin 2 \varphi, 0),\quad \varphi = 2 \pi t / P

    >>> FigureEight(period=4.0).at(torch.ones(()))[:2].round(decimals=4)
    tensor([1., -0.])
    """

    @options("figure_8")
    def __init__(
        self,
        length: Annotated[Positive, "half length a, m"] = 1.0,
        width: Annotated[Positive, "half width b, m"] = 0.5,
        period: Annotated[Positive, "P, s"] = 8.0,
    ) -> None:
        self.length, self.width, self.pulse = length, width, 2 * math.pi / period
        self.name = f"figure_8_{period:g}s"

    def at(self, time: Tensor) -> Tensor:
        angle = time * self.pulse
        none, fast = torch.zeros_like(angle), self.width * 2 * self.pulse
        here = [self.length * angle.sin(), self.width * (2 * angle).sin(), none]
        speed = [self.length * self.pulse * angle.cos(), fast * (2 * angle).cos(), none]
        return torch.stack(here + speed, -1)


def find_reference(name: str) -> Reference:
    """Return a reference by its name, or from a CSV file.

    Args:
        name: ``hover``, ``circle_2m_0.8mps`` (radius, speed), ``figure_8_8s`` (period), or the path
            of a CSV file; see :func:`load_reference`.

    Raises:
        ConfigurationError: if there is no such reference, or the file cannot be used.

    >>> find_reference("circle_3m_1.2mps").speed
    1.2
    """
    number = r"(\d+(?:\.\d+)?)"
    named: dict[str, Callable[..., Reference]] = {
        "hover": Hover,
        f"circle_{number}m_{number}mps": Circle,
        f"figure_8_{number}s": lambda period: FigureEight(period=period),
    }
    for pattern, make in named.items():
        match = re.fullmatch(pattern, name)
        if match:
            return make(*map(float, match.groups()))
    if not name.lower().endswith(".csv"):
        raise ConfigurationError(
            f"tracks={name!r}: expected hover, a circle such as circle_2m_0.8mps (radius, speed), "
            "a figure of eight such as figure_8_8s (period), or the path of a CSV file"
        )
    return load_reference(name)
