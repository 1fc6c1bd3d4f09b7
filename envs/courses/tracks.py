"""Where tracks come from: the catalogue, or a file of the user's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from afm_rl.envs.courses.columns import read_columns
from afm_rl.envs.courses.geometry import Pieces, poses_at, round_corners, station_of
from afm_rl.envs.courses.track import Track, check_closed, local_origin
from afm_rl.errors import ConfigurationError

MAPS = Path(__file__).with_name("maps")
# The ETHZ 1:43 race tracks (Liniger et al. 2015), six times as large: start x, y and width (m).
CATALOGUE = {"ethz_1": ((-5.07, 6.59), 2.2), "ethz_2": ((7.2, 5.4), 2.8)}


def load_track(source: str | Path) -> Track:
    """Return a track of the catalogue, or one from a CSV file.

    A file with the columns ``x,y`` lists waypoints: the robot starts at the first and faces
    the second. With ``x,y,radius`` it lists the corners of a closed polygon and their fillet
    radii (m): waypoints then stand about 3.5 m apart, the first one where the first corner's
    arc ends. Either closes by itself: the first row is not repeated. Coordinates may be those of a
    map (UTM, m): the track's are relative to its ``origin``.

    Args:
        source: ``ethz_1``, ``ethz_2``, or the path of a CSV file.

    Raises:
        ConfigurationError: if there is no such track, or the file cannot be used.

    >>> track = load_track("ethz_2")
    >>> track.start
    tensor([7.2000, 5.4000, 0.0000], dtype=torch.float64)
    >>> track.targets.shape, load_track("ethz_1").targets.shape
    (torch.Size([19, 2]), torch.Size([34, 2]))
    """
    if str(source) in CATALOGUE:
        return _from_catalogue(str(source))
    path = Path(source if isinstance(source, (str, Path)) else "")
    if path.suffix.lower() != ".csv":
        raise ConfigurationError(
            f"tracks={str(source)!r}: expected one of {', '.join(CATALOGUE)}, or the path of a "
            "CSV file with the columns x,y or x,y,radius"
        )
    header, table = read_columns(path, [("x", "y"), ("x", "y", "radius")])
    return _from_corners(path.stem, table) if len(header) == 3 else _from_points(path.stem, table)


def _from_catalogue(name: str) -> Track:
    start, width = CATALOGUE[name]
    _, corners = read_columns(MAPS / f"{name}.csv", [("x", "y", "radius")])
    _, stations = read_columns(MAPS / f"{name}_stations.csv", [("station",)])
    pieces = round_corners(corners[:, :2], corners[:, 2], name)
    first = station_of(pieces, torch.tensor(start, dtype=corners.dtype))
    return replace(_along(name, pieces, first + stations[:, 0]), width=width)


def _from_corners(name: str, corners: Tensor, spacing: float = 3.5) -> Track:
    check_closed(corners[:, :2], name, "vertex")
    if (corners[:, 2] < 0).any():
        low = float(corners[:, 2].min())
        raise ConfigurationError(f"tracks: {name}: radius {low:g}: expected at least 0 m")
    origin = local_origin(corners[:, :2])  # first, so that nothing is rounded far from zero
    pieces = round_corners(corners[:, :2] - origin, corners[:, 2], name)
    length = float(pieces.length.sum())
    count = max(2, round(length / spacing))
    stations = torch.arange(count, dtype=corners.dtype) * (length / count)
    return replace(_along(name, pieces, stations), origin=origin)


def _from_points(name: str, points: Tensor) -> Track:
    check_closed(points, name, "waypoint")
    origin = local_origin(points)
    points = points - origin
    pieces = round_corners(points, points.new_zeros(len(points)), name)
    corners = (pieces.length.cumsum(0) - pieces.length)[::2]
    return replace(_along(name, pieces, corners), waypoints=points, origin=origin)


def _along(name: str, pieces: Pieces, stations: Tensor, drawn: float = 0.05) -> Track:
    """Put waypoints at ``stations``, and points of the centre line every ``drawn`` m."""
    poses = poses_at(pieces, stations)
    dense = torch.arange(0.0, float(pieces.length.sum()), drawn, dtype=stations.dtype)
    line = poses_at(pieces, dense)[:, :2].contiguous()
    return Track(name, poses[:, :2].contiguous(), poses[0], line)
