"""The tracks of the catalogue, the user's files, and what is wrong with them."""

import math

import pytest
import torch
from harness import refused

from afm_rl.envs import Track, load_track
from afm_rl.envs.courses.track import read_columns
from afm_rl.envs.courses.tracks import MAPS, poses_at, round_corners, station_of
from afm_rl.errors import ConfigurationError
from afm_rl.spaces.manifold import wrap_angle


def write(folder, text, name="mine.csv"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("name", "length", "targets", "width"), [("ethz_1", 107.2, 34, 2.2), ("ethz_2", 77.1, 19, 2.8)]
)
def test_the_catalogue_has_the_published_sizes(name, length, targets, width):
    track = load_track(name)
    _, corners = read_columns(MAPS / f"{name}.csv", [("x", "y", "radius")])
    line = round_corners(corners[:, :2], corners[:, 2])
    assert float(line.length.sum()) == pytest.approx(length, abs=0.05)
    assert track.targets.shape == (targets, 2)
    assert track.width == width
    torch.testing.assert_close(track.targets[0], track.targets[-1])


@pytest.mark.parametrize("name", ["ethz_1", "ethz_2"])
def test_waypoints_lie_on_the_centre_line_in_driving_order(name):
    track = load_track(name)
    distance = torch.cdist(track.waypoints, track.centerline)
    assert distance.amin(-1).max() < 0.03  # half the spacing of the drawn points
    nearest = distance.argmin(-1)
    ahead = (nearest.roll(-1) - nearest) % len(track.centerline)
    assert int(ahead.sum()) == len(track.centerline)  # once around


def test_the_second_track_has_uniform_stations():
    track = load_track("ethz_2")
    _, corners = read_columns(MAPS / "ethz_2.csv", [("x", "y", "radius")])
    line = round_corners(corners[:, :2], corners[:, 2])
    first = float(line.length.sum() - line.length[-1])  # the start is where the last arc begins
    stations = first + 4.5 * torch.arange(18, dtype=torch.float64)
    torch.testing.assert_close(track.waypoints, poses_at(line, stations)[:, :2])


def test_a_file_of_waypoints(tmp_path):
    track = load_track(write(tmp_path, "x,y\n1,2\n1,5\n\n4, 5\n"))
    assert track.name == "mine"
    assert track.waypoints.tolist() == [[1, 2], [1, 5], [4, 5]]
    torch.testing.assert_close(track.start, torch.tensor([1, 2, math.pi / 2]).double())


def test_a_file_written_by_a_spreadsheet(tmp_path):
    track = load_track(write(tmp_path, "\ufeffX, Y\r\n0,0\r\n3,0\r\n"))
    assert track.targets.tolist() == [[0, 0], [3, 0], [0, 0]]


def test_a_file_of_corners_and_radii(tmp_path):
    path = write(tmp_path, "x,y,radius\n0,0,1\n9,0,1\n9,9,1\n0,9,0\n")
    track = load_track(str(path))
    length = 36 - 3 * 2 + 3 * math.pi / 2
    assert len(track.waypoints) == round(length / 3.5)
    torch.testing.assert_close(track.start, torch.tensor([1.0, 0.0, 0.0]).double())


@refused(
    ("x,y\n0,0\n1,zwei\n", r"line 3: 'zwei' is not a finite number"),
    ("x,y\n0,0\ninf,1\n", r"line 3: 'inf' is not a finite number"),
    ("x,y\n0,0\n1,2,3\n", r"line 3: 3 values, expected 2"),
    ("x,z\n0,0\n1,1\n", r"first line is x,z, expected x,y or x,y,radius"),
    ("", r"first line is nothing, expected"),
    ("x,y\n0,0\n", r"waypoint count 1: expected at least 2"),
    ("x,y,radius\n0,0,1\n", r"vertex count 1: expected at least 2"),
    ("x,y\n0,0\n0,0\n1,1\n", r"waypoint 1 and waypoint 2 coincide"),
    ("x,y\n0,0\n1,1\n0,0\n", r"waypoint 3 and waypoint 1 coincide"),
    ("x,y,radius\n0,0,1\n9,0,-1\n9,9,1\n", r"radius -1: expected at least 0"),
    (
        "x,y,radius\n0,0,1\n9,0,8\n9,9,1\n",
        r"mine: radius .* of vertex . and .* of vertex . do not fit",
    ),
    says="^tracks: .*{}",
)
def test_a_bad_file_is_refused_in_one_line(text, tmp_path):
    load_track(write(tmp_path, text))


@pytest.mark.parametrize("name", ["missing.csv", "folder.csv"])
def test_a_file_that_cannot_be_opened_is_refused(tmp_path, name):
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(ConfigurationError, match="tracks: cannot read"):
        load_track(tmp_path / name)


@pytest.mark.parametrize("source", ["ethz_3", "", 7])
def test_an_unknown_name_lists_what_there_is(source):
    with pytest.raises(ConfigurationError, match="expected one of ethz_1, ethz_2, or the path"):
        load_track(source)


@refused(
    ({"waypoints": torch.zeros(3)}, "waypo"),
    ({"waypoints": torch.tensor([[0.0, 0.0], [math.nan, 1.0]])}, "waypo"),
    ({"start": torch.zeros(2)}, "start"),
    ({"start": torch.full((3,), math.inf)}, "start"),
    ({"centerline": torch.zeros(5, 3)}, "cente"),
    ({"width": 0.0}, "width"),
    says="tracks: mine: {}",
)
def test_a_track_checks_itself(fields):
    points = torch.tensor([[0.0, 0.0], [4.0, 0.0]])
    sound = {"waypoints": points, "start": torch.zeros(3), "centerline": points}
    Track("mine", **{**sound, **fields})


BLOCK = torch.tensor([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]], dtype=torch.float64)


def square(folder, x=0.0, y=0.0, side=1.0, name="square"):
    rows = "".join(f"{x + side * a!r},{y + side * b!r}\n" for a, b in BLOCK.tolist())
    return write(folder, "x,y\n" + rows, f"{name}.csv")


@pytest.mark.parametrize(("x", "y"), [(1e7, -1e7), (500_000.0, 5_400_000.0)])
def test_far_from_zero_is_as_near(tmp_path, x, y):
    near = load_track(square(tmp_path, name="near"))
    far = load_track(square(tmp_path, x, y, name="far"))
    assert (near.origin.tolist(), far.origin.tolist()) == ([0, 0], [x, y])
    for part in ("waypoints", "start", "centerline"):
        assert torch.equal(getattr(near, part), getattr(far, part))
    points = near.waypoints + far.origin
    whole = Track("far", points, torch.cat([points[0], torch.zeros(1)]), points)
    assert torch.equal(whole.waypoints, near.waypoints) and whole.origin.tolist() == [x, y]


@refused(
    ({"side": 5e4}, "tracks: square: a course of 800 km: expected at most 100 km"),
    ({"side": 1e30}, r"square: waypoint 2 at \[4e\+30, 0.0\]: expected coordinates of at most"),
)
def test_tracks_that_nobody_can_mean_are_refused(settings, tmp_path):
    load_track(square(tmp_path, **settings))


def rounded(radius):
    return round_corners(BLOCK, torch.full((4,), radius, dtype=torch.float64))


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


@pytest.mark.parametrize("turned", [BLOCK, BLOCK.flip(0)], ids=["left", "right"])
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
    near_the_arc = torch.tensor([3.8, 0.1]).double()
    assert float(station_of(rounded(1.0), near_the_arc)) == pytest.approx(2.0)
