"""What a track is, several of them as tensors, and how files of numbers are read."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from afm_rl.errors import ConfigurationError, check_number, refusing


def read_columns(
    path: str | Path, headers: Sequence[tuple[str, ...]]
) -> tuple[tuple[str, ...], Tensor]:
    """Return the header of a CSV file, one of ``headers``, and its finite numbers ``(R, C)``.

    Raises:
        ConfigurationError: naming file and line, if it cannot be read as that.

    >>> read_columns(Path(__file__).with_name("maps") / "ethz_2.csv", [("x", "y", "radius")])[0]
    ('x', 'y', 'radius')
    """
    path = Path(path)
    with (
        refusing(f"tracks: cannot read {path}"),
        path.open(newline="", encoding="utf-8-sig") as file,
    ):
        lines = [(i, line) for i, line in enumerate(csv.reader(file), start=1) if any(line)]
    header = tuple(cell.strip().lower() for cell in lines[0][1]) if lines else ()
    if header not in headers:
        allowed = " or ".join(",".join(columns) for columns in headers)
        first_line = ",".join(header) or "nothing"
        raise ConfigurationError(
            f"tracks: {path}: the first line is {first_line}, expected {allowed}"
        )
    rows = []
    for number, line in lines[1:]:
        if len(line) != len(header):
            raise ConfigurationError(
                f"tracks: {path}, line {number}: {len(line)} values, expected {len(header)}"
            )
        rows.append([_finite(cell, f"{path}, line {number}") for cell in line])
    return header, torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(header))


def _finite(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigurationError(f"tracks: {where}: {cell!r} is not a finite number")
    return value


LONGEST = 1e5  # m: a longer course is a typing error, and its centre line would fill the memory


def local_origin(points: Tensor) -> Tensor:
    """Return the corner of a grid of kilometres that is nearest to the middle of points ``(N, D)``.

    Single precision has 7 digits: in UTM coordinates, of 5e6 m, steps of half a metre. Relative to
    this origin, they are below 0.1 mm. It is zero for points around zero.

    >>> local_origin(torch.tensor([[500_123.4, 5_400_007.8]]))
    tensor([ 500000., 5400000.])
    """
    return (points.mean(0) / 1e3).round() * 1e3  # m


def check_near(points: Tensor, name: str, farthest: float = 1e8) -> None:
    """Refuse ``points`` ``(N, D)`` that are nowhere on Earth (m from zero), naming the first."""
    far = points.abs().amax(-1) > farthest
    if far.any():
        first = int(far.nonzero()[0])
        raise ConfigurationError(
            f"tracks: {name} {first + 1} at {points[first].tolist()}: expected coordinates of at "
            f"most {farthest:g} m"
        )


@dataclass(frozen=True, eq=False)
class Track:
    """A closed course.

    Points far from zero are shifted by whole kilometres when the track is made.

    Attributes:
        name: name in logs and tables.
        waypoints: points to reach in order (m), ``(W, 2)``.
        start: pose of the robot before the start noise: x, y (m), heading (rad), ``(3,)``.
        centerline: dense line to draw (m), ``(M, 2)``.
        width: width of the road, for drawing only (m).
        origin: offset subtracted from all points (m), ``(2,)``; see :func:`local_origin`.

    Raises:
        ConfigurationError: for points too far from zero or from each other, fewer than two
            waypoints, neighbours that coincide, a wrong shape or a number that is not finite.

    >>> corners = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])
    >>> Track("triangle", corners, torch.zeros(3), corners).targets.shape
    torch.Size([4, 2])
    """

    name: str
    waypoints: Tensor
    start: Tensor
    centerline: Tensor
    width: float = 2.0
    origin: Tensor = field(default_factory=lambda: torch.zeros(2, dtype=torch.float64))

    def __post_init__(self) -> None:
        check_number(f"tracks: {self.name}: width", self.width, low=0.0, open_low=True)
        check_closed(self.waypoints, self.name, "waypoint")
        for name, value, dims, columns in (
            ("start", self.start, 1, 3),
            ("centerline", self.centerline, 2, 2),
        ):
            if value.dim() != dims or value.shape[-1] != columns or not value.isfinite().all():
                raise ConfigurationError(
                    f"tracks: {self.name}: {name} {tuple(value.shape)}: expected finite numbers "
                    f"of shape {'(3,)' if dims == 1 else '(M, 2)'}"
                )
        shift = local_origin(self.waypoints)
        if shift.any():
            move = torch.cat([shift, shift.new_zeros(1)])
            object.__setattr__(self, "origin", self.origin + shift)
            object.__setattr__(self, "waypoints", self.waypoints - shift)
            object.__setattr__(self, "centerline", self.centerline - shift)
            object.__setattr__(self, "start", self.start - move)

    @property
    def targets(self) -> Tensor:
        """The waypoints, then the first one again (m), ``(W + 1, 2)``."""
        return torch.cat([self.waypoints, self.waypoints[:1]])


def check_closed(points: Tensor, name: str, what: str) -> None:
    """Refuse ``points`` that are no closed course: two or more, neighbours distinct, not absurd."""
    if points.dim() != 2 or points.shape[-1] != 2 or not points.isfinite().all():
        raise ConfigurationError(
            f"tracks: {name}: {what} table {tuple(points.shape)}: expected finite numbers (W, 2)"
        )
    if len(points) < 2:
        raise ConfigurationError(f"tracks: {name}: {what} count {len(points)}: expected at least 2")
    check_near(points, f"{name}: {what}")
    length = float((points.roll(-1, 0) - points).norm(dim=-1).sum())
    if length > LONGEST:
        raise ConfigurationError(
            f"tracks: {name}: a course of {length / 1e3:.4g} km: expected at most "
            f"{LONGEST / 1e3:g} km; coordinates are metres"
        )
    same = (points.roll(-1, 0) == points).all(-1)
    if same.any():
        first = int(same.nonzero()[0]) + 1
        raise ConfigurationError(
            f"tracks: {name}: {what} {first} and {what} {first % len(points) + 1} coincide; the "
            "track is closed automatically, so omit one of them"
        )


class Course(nn.Module):
    """The targets of T tracks, looked up per mission.

    Args:
        tracks: the tracks.
        dtype: floating-point type.

    Attributes:
        targets: targets (m), ``(T, N, 2)``, short rows padded with their last target.
        counts: number n of targets per track, ``(T,)``.
        starts: start poses (m, m, rad), ``(T, 3)``.

    >>> from afm_rl.envs.courses.tracks import load_track
    >>> course = Course([load_track("ethz_1"), load_track("ethz_2")])
    >>> course.counts
    tensor([34, 19])
    >>> course.progress(torch.tensor([0, 1]), torch.tensor([17, 19]))
    tensor([0.5000, 1.0000])
    """

    targets: Tensor
    counts: Tensor
    starts: Tensor

    def __init__(self, tracks: Sequence[Track], dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        rows = [track.targets for track in tracks]
        counts = [len(row) for row in rows]
        padded = [torch.cat([row, row[-1:].expand(max(counts) - len(row), 2)]) for row in rows]
        starts = torch.stack([track.start for track in tracks])
        self.register_buffer("targets", torch.stack(padded).to(dtype), persistent=False)
        self.register_buffer("counts", torch.tensor(counts), persistent=False)
        self.register_buffer("starts", starts.to(dtype), persistent=False)

    def goal(self, track: Tensor, reached: Tensor) -> Tensor:
        """Return the current target ``(*B, 2)``; after the last one it stays the last."""
        return self.targets[track, reached.minimum(self.counts[track] - 1)]

    def progress(self, track: Tensor, reached: Tensor) -> Tensor:
        """Return the share of targets reached ``(*B)``, in [0, 1]."""
        return reached.to(self.targets.dtype) / self.counts[track]

    def finished(self, track: Tensor, reached: Tensor) -> Tensor:
        """Return whether all targets are reached ``(*B)``."""
        return reached >= self.counts[track]
