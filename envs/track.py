"""What a track is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_number


@dataclass(frozen=True, eq=False)
class Track:
    """A closed course.

    Attributes:
        name: what logs and tables call it.
        waypoints: points to reach in order (m), ``(W, 2)``.
        start: pose of the robot before the start noise: x, y (m), heading (rad), ``(3,)``.
        centerline: dense line to draw (m), ``(M, 2)``.
        width: width of the road, for drawing only (m).

    Raises:
        ConfigurationError: for fewer than two waypoints, neighbours that coincide, a wrong
            shape or a number that is not finite.

    >>> corners = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])
    >>> Track("triangle", corners, torch.zeros(3), corners).targets.shape
    torch.Size([4, 2])
    """

    name: str
    waypoints: Tensor
    start: Tensor
    centerline: Tensor
    width: float = 2.0

    def __post_init__(self) -> None:
        check_number(f"tracks: {self.name}: width", self.width, low=0.0, open_low=True)
        check_closed(self.waypoints, self.name, "waypoint")
        for field, value, dims, columns in (
            ("start", self.start, 1, 3),
            ("centerline", self.centerline, 2, 2),
        ):
            if value.dim() != dims or value.shape[-1] != columns or not value.isfinite().all():
                raise ConfigurationError(
                    f"tracks: {self.name}: {field} {tuple(value.shape)}: expected finite numbers "
                    f"of shape {'(3,)' if dims == 1 else '(M, 2)'}"
                )

    @property
    def targets(self) -> Tensor:
        """The waypoints, then the first one again (m), ``(W + 1, 2)``."""
        return torch.cat([self.waypoints, self.waypoints[:1]])


def check_closed(points: Tensor, name: str, what: str) -> None:
    """Refuse ``points`` that are no closed course: at least two, neighbours distinct.

    Raises:
        ConfigurationError: naming the track and the first offending pair.
    """
    if points.dim() != 2 or points.shape[-1] != 2 or not points.isfinite().all():
        raise ConfigurationError(
            f"tracks: {name}: {what} table {tuple(points.shape)}: expected finite numbers (W, 2)"
        )
    if len(points) < 2:
        raise ConfigurationError(f"tracks: {name}: {what} count {len(points)}: expected at least 2")
    same = (points.roll(-1, 0) == points).all(-1)
    if same.any():
        first = int(same.nonzero()[0]) + 1
        raise ConfigurationError(
            f"tracks: {name}: {what} {first} and {what} {first % len(points) + 1} coincide; the "
            "track closes by itself, so leave one of them out"
        )
