"""Rounded polygons against closed forms."""

import math

import pytest
import torch

from afm_rl.envs.courses.tracks import poses_at, round_corners, station_of
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import wrap_angle

SQUARE = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]], dtype=torch.float64)


def rounded(radius):
    return round_corners(SQUARE, torch.full((4,), radius, dtype=torch.float64))


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0, 2.0])
def test_a_rounded_square_is_as_long_as_its_straights_and_one_circle(radius):
    expected = 4 * (4 - 2 * radius) + 2 * math.pi * radius
    assert float(rounded(radius).length.sum()) == pytest.approx(expected, abs=1e-9)


def test_poses_on_a_quarter_circle():
    stations = torch.tensor([2.0, 2 + math.pi / 4, 2 + math.pi / 2], dtype=torch.float64)
    half = math.sqrt(0.5)
    expected = torch.tensor(
        [[3, 0, 0], [3 + half, 1 - half, math.pi / 4], [4, 1, math.pi / 2]], dtype=torch.float64
    )
    torch.testing.assert_close(poses_at(rounded(1.0), stations), expected)


@pytest.mark.parametrize("turned", [SQUARE, SQUARE.flip(0)], ids=["left", "right"])
def test_the_line_is_continuous_and_closed(turned):
    pieces = round_corners(turned, torch.tensor([1.0, 0.2, 1.5, 0.7], dtype=torch.float64))
    ends = poses_at(pieces, pieces.length.cumsum(0) - 1e-12)
    torch.testing.assert_close(ends[:, :2], pieces.origin.roll(-1, 0))
    bend = wrap_angle(ends[:, 2] - pieces.heading.roll(-1))
    torch.testing.assert_close(bend, torch.zeros_like(bend), atol=1e-9, rtol=0)


def test_stations_wrap_around():
    pieces = rounded(1.0)
    early = torch.tensor([0.3], dtype=torch.float64)
    torch.testing.assert_close(
        poses_at(pieces, pieces.length.sum() + early), poses_at(pieces, early)
    )


def test_the_station_of_a_point_ignores_arcs():
    pieces = rounded(1.0)
    assert float(station_of(pieces, torch.tensor([2.0, -0.1]).double())) == pytest.approx(1.0)
    near_the_arc = torch.tensor([3.8, 0.1]).double()
    assert float(station_of(pieces, near_the_arc)) == pytest.approx(2.0)


def test_a_radius_that_does_not_fit_names_both_vertices():
    radii = torch.tensor([1.0, 3.5, 1.0, 1.0], dtype=torch.float64)
    with pytest.raises(ConfigurationError, match=r"tracks: box: radius .* vertex .* do not fit"):
        round_corners(SQUARE, radii, "box")
