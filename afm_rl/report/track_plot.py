"""Tracks as maps show them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection

from afm_rl.errors import ConfigurationError
from afm_rl.report.style import ROAD


class Box(NamedTuple):
    """The area that a map shows (m)."""

    left: float
    right: float
    bottom: float
    top: float

    @property
    def span(self) -> tuple[float, float]:
        """Width and height."""
        return self.right - self.left, self.top - self.bottom

    @property
    def ratio(self) -> float:
        """Height over width."""
        return self.span[1] / self.span[0]


class DrawableTrack(Protocol):
    """What a figure must know of a track; lengths in metres."""

    @property
    def name(self) -> str:
        """Name in the tables."""

    @property
    def waypoints(self) -> Any:
        """Points to reach, ``(W, 2)``."""

    @property
    def centerline(self) -> Any:
        """Dense closed line, ``(M, 2)``."""

    @property
    def width(self) -> float:
        """Width of the road."""


def load_tracks(
    names: Iterable[str], load_track: Callable[[str], DrawableTrack]
) -> list[DrawableTrack]:
    """Return the tracks that can be loaded by name; a map without its road is a map."""
    tracks = []
    for name in names:
        with suppress(ConfigurationError):
            tracks.append(load_track(str(name)))
    return tracks


def draw_road(axes: Axes, track: DrawableTrack) -> None:
    """Draw the road as a ribbon, with its waypoints.

    The ribbon is a row of discs: it is as wide as the track says whatever the size of the axes, and
    sharp corners come out right.
    """
    middle = np.asarray(track.centerline, dtype=float)
    size = np.full(len(middle), float(track.width))
    discs = EllipseCollection(
        size, size, np.zeros(len(middle)), units="xy", offsets=middle, facecolors=ROAD, linewidths=0
    )
    discs.set(offset_transform=axes.transData, gid="road", zorder=0.5)
    axes.add_collection(discs)
    x, y = np.asarray(track.waypoints, dtype=float).T
    axes.plot(x, y, ".", color="#9a9a9a", markersize=3.5, zorder=1, gid="waypoints")


def view(
    track: DrawableTrack | None,
    paths: Sequence[np.ndarray],
    margin: float = 0.04,
    stray: float = 0.15,
) -> Box:
    """Return the area to show of a track and paths ``(N, 2)``.

    Paths that leave the road are followed a little way only: a robot that has gone astray
    must not shrink the road to a dot.

    Args:
        track: the road.
        paths: where robots went (m).
        margin: shown around all, as a part of the longer side.
        stray: shown of those who leave the road, as a part of the road's sides.
    """
    points = np.concatenate([path[np.isfinite(path).all(-1)] for path in paths])
    if track is None:
        edge, stray = points, 0.0
    else:
        line, half = np.asarray(track.centerline, dtype=float), track.width / 2
        edge = np.concatenate([line - half, line + half])
    low, high = (edge.min(0), edge.max(0)) if len(edge) else (np.zeros(2), np.ones(2))
    span = np.maximum(high - low, 1e-3)
    if len(points):
        low = np.minimum(low, np.maximum(points.min(0), low - stray * span))
        high = np.maximum(high, np.minimum(points.max(0), high + stray * span))
    around = margin * span.max()
    (left, bottom), (right, top) = (low - around).tolist(), (high + around).tolist()
    return Box(left, right, bottom, top)


def distance_to(track: DrawableTrack, point: np.ndarray) -> float:
    """Return how far a point ``(2,)`` is from the road's centre line (m)."""
    return float(np.hypot(*(np.asarray(track.centerline, dtype=float) - point).T).min())
