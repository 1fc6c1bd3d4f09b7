"""Where tracks come from: the catalogue, or a file of the user's."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from afm_rl.envs.courses.track import Track, check_closed, local_origin, read_columns
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import wrap_angle


class Pieces(NamedTuple):
    """N pieces of constant curvature: where each begins (m) and heads (rad), 1/m, and m."""

    origin: Tensor
    heading: Tensor
    curvature: Tensor
    length: Tensor


def round_corners(vertices: Tensor, radii: Tensor, name: str = "polygon") -> Pieces:
    r"""Round the corners ``(V, 2)`` of a closed polygon by fillets of these radii ``(V,)``, in m.

    A corner that turns by :math:`\phi` becomes an arc of radius :math:`r` which touches both
    edges :math:`r \tan(|\phi| / 2)` away from the vertex. The line begins where the arc of the
    first vertex ends, and heads for the second vertex.

    >>> square = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    >>> round(float(round_corners(square, torch.ones(4)).length.sum() - 8), 4)  # 2 pi
    6.2832
    """
    edges = vertices.roll(-1, 0) - vertices
    heading = torch.atan2(edges[:, 1], edges[:, 0])
    forward = torch.stack([heading.cos(), heading.sin()], -1)
    turn = wrap_angle(heading - heading.roll(1))
    cut = radii * (turn.abs() / 2).tan()
    straight = edges.norm(dim=-1) - cut - cut.roll(-1)
    if (straight < -1e-6).any():
        corner = int(straight.argmin())
        following = (corner + 1) % len(vertices)
        raise ConfigurationError(
            f"tracks: {name}: radius {radii[corner]:g} m of vertex {corner + 1} and "
            f"{radii[following]:g} m of vertex {following + 1} do not fit on the edge between "
            "them; make them smaller"
        )
    arc = (radii * turn.abs()).roll(-1)  # the arc after edge i belongs to vertex i + 1
    bend = torch.where(arc > 0, turn.roll(-1) / arc.clamp(min=1e-12), 0.0)
    begin = vertices + cut[:, None] * forward
    end = vertices.roll(-1, 0) - cut.roll(-1)[:, None] * forward
    return Pieces(
        origin=torch.stack([begin, end], 1).flatten(0, 1),
        heading=heading.repeat_interleave(2),
        curvature=torch.stack([torch.zeros_like(bend), bend], 1).flatten(),
        length=torch.stack([straight.clamp(min=0.0), arc], 1).flatten(),
    )


def poses_at(pieces: Pieces, stations: Tensor) -> Tensor:
    r"""Return the poses x, y (m), heading (rad) ``(M, 3)`` at arc lengths ``(M,)``.

    Along a piece of curvature :math:`\kappa` the chord of arc length :math:`u` has the length
    :math:`u\,\mathrm{sinc}(\kappa u / 2)` and the direction of the arc's middle, which holds
    for straights as well. Stations wrap around: the line is closed.

    >>> square = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    >>> poses_at(round_corners(square, torch.ones(4)), torch.tensor([1.0]))
    tensor([[2., 0., 0.]])
    """
    ends = pieces.length.cumsum(0)
    wrapped = stations % ends[-1]
    index = torch.searchsorted(ends, wrapped, right=True).clamp(max=len(ends) - 1)
    along = wrapped - (ends - pieces.length)[index]
    half = pieces.curvature[index] * along / 2
    chord = along * torch.sinc(half / math.pi)
    middle = pieces.heading[index] + half
    moved = chord[:, None] * torch.stack([middle.cos(), middle.sin()], -1)
    heading = wrap_angle(middle + half)
    return torch.cat([pieces.origin[index] + moved, heading[:, None]], -1)


def station_of(pieces: Pieces, point: Tensor) -> Tensor:
    """Return the arc length ``()`` of the point on a straight that is nearest to ``point``.

    >>> square = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    >>> station_of(round_corners(square, torch.ones(4)), torch.tensor([2.5, 0.1]))
    tensor(1.5000)
    """
    forward = torch.stack([pieces.heading.cos(), pieces.heading.sin()], -1)
    along = ((point - pieces.origin) * forward).sum(-1).clamp(min=0.0).minimum(pieces.length)
    away = (pieces.origin + along[:, None] * forward - point).norm(dim=-1)
    index = torch.where(pieces.curvature == 0, away, torch.inf).argmin()
    return (pieces.length.cumsum(0) - pieces.length + along)[index]


MAPS = Path(__file__).with_name("maps")
# The ETHZ 1:43 race tracks (Liniger et al. 2015), six times as large: start x, y and width (m).
CATALOGUE = {"ethz_1": ((-5.07, 6.59), 2.2), "ethz_2": ((7.2, 5.4), 2.8)}


def load_track(source: str | Path) -> Track:
    """Return a track of the catalogue, or one from a CSV file.

    A file with the columns ``x,y`` lists waypoints: the robot starts at the first and faces
    the second. With ``x,y,radius`` it lists the corners of a closed polygon and their fillet
    radii (m): waypoints then stand about 3.5 m apart, the first one where the first corner's
    arc ends. Tracks are closed automatically: the first row is not repeated. Coordinates may be
    those of a map (UTM, m): those of the track are relative to its ``origin``.

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
