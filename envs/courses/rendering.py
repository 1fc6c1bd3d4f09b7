"""Pictures of a robot on a track, without a screen."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from matplotlib.patches import Circle, Polygon
from torch import Tensor

from afm_rl.envs.courses.track import Track
from afm_rl.errors import check_count
from afm_rl.film import picture, sheet

LINE = "#999999"
DPI = 64  # a power of two, so that sizes in inches are exact
OUTLINE = torch.tensor([[0.6, 0.0], [-0.4, 0.35], [-0.2, 0.0], [-0.4, -0.35]])  # robot (m)


def robot_outline(pose: Tensor) -> Tensor:
    """Return the corners ``(4, 2)`` of the arrow drawn for a robot at ``pose`` ``(3,)``.

    >>> robot_outline(torch.zeros(3))[0]
    tensor([0.6000, 0.0000])
    """
    cos, sin = pose[2].cos(), pose[2].sin()
    turn = torch.stack([torch.stack([cos, sin]), torch.stack([-sin, cos])])
    return pose[:2] + OUTLINE.to(pose) @ turn


class TrackCanvas:
    """A picture of a track, on which the robot is drawn at different poses.

    Uses matplotlib's objects, so no window opens and no global figure remains.

    Args:
        track: what to draw.
        pixels: length of the longer side. Either side becomes a multiple of 16, the block of
            video encoders.
        margin: between the course and the edge of the picture (m).

    >>> from afm_rl.envs.courses.tracks import load_track
    >>> frame = TrackCanvas(load_track("ethz_2"), pixels=128).draw(torch.zeros(3), torch.ones(2))
    >>> frame.dtype, frame.shape[2], max(frame.shape)
    (dtype('uint8'), 3, 128)
    """

    def __init__(self, track: Track, pixels: int = 480, margin: float = 2.0) -> None:
        self.pixels = check_count("pixels", pixels, low=16)
        points = torch.cat([track.centerline, track.waypoints])
        edge = margin + track.width / 2
        low, high = points.amin(0) - edge, points.amax(0) + edge
        metre = self.pixels / float((high - low).max())  # in pixels
        size = 16 * torch.ceil((high - low) * metre / 16)
        middle, half = (low + high) / 2, size / metre / 2
        (left, bottom), (right, top) = (middle - half).tolist(), (middle + half).tolist()
        self.figure = sheet(float(size[0]) / DPI, float(size[1]) / DPI, DPI)
        axes = self.figure.add_axes((0, 0, 1, 1), xlim=(left, right), ylim=(bottom, top))
        axes.set_axis_off()
        x, y = torch.cat([track.centerline, track.centerline[:1]]).unbind(-1)
        (road,) = axes.plot(x, y, color="#dddddd", linewidth=track.width * metre * 72 / DPI)
        road.set(solid_capstyle="round", solid_joinstyle="round")
        axes.plot(x, y, color=LINE, linewidth=1, linestyle="--")
        axes.plot(*track.waypoints.unbind(-1), color=LINE, linestyle="", marker="o", markersize=3)
        (self._trail,) = axes.plot([], [], color="#56b4e9", linewidth=1.5)
        self._goal = Circle((0, 0), fill=False, edgecolor="#d55e00", linewidth=2, zorder=3)
        self._robot = Polygon(OUTLINE.numpy(), color="#0072b2", zorder=3)
        axes.add_patch(self._goal)
        axes.add_patch(self._robot)

    def draw(
        self, pose: Tensor, goal: Tensor, trail: Tensor | None = None, reach: float = 0.5
    ) -> np.ndarray:
        """Return a picture ``(H, W, 3)`` of bytes.

        Args:
            pose: x, y (m), theta (rad) of the robot, ``(3,)``.
            goal: its target (m), ``(2,)``.
            trail: its earlier positions (m), ``(M, 2)`` or more columns.
            reach: radius around the target (m).
        """
        self._robot.set_xy(robot_outline(pose.detach().cpu()).numpy())
        self._goal.set(center=goal.detach().cpu().tolist(), radius=reach)
        where = torch.zeros(0, 2) if trail is None else trail.detach().cpu()
        self._trail.set_data(where[:, 0].numpy(), where[:, 1].numpy())
        return picture(self.figure)


@lru_cache(maxsize=8)
def canvas_of(track: Track, pixels: int = 480) -> TrackCanvas:
    """Return the canvas of a track, the same one each time."""
    return TrackCanvas(track, pixels)
