"""Reference flights: by name, from a file, and how they begin."""

import pytest
import torch
from harness import refused

from afm_rl.envs import (
    Circle,
    CrazyflieTrack,
    FigureEight,
    Hover,
    SampledReference,
    find_reference,
    load_reference,
)
from afm_rl.envs.courses.flights import references_at
from afm_rl.errors import ConfigurationError

ALL = [Hover(), Circle(3.0, 1.2), FigureEight(), Circle(1.0, 0.5)]


@pytest.mark.parametrize("reference", ALL, ids=lambda one: one.name)
@pytest.mark.parametrize("shape", [(), (7,), (2, 5)])
def test_velocities_are_those_of_the_positions(reference, shape):
    time = 0.1 + 7 * torch.rand(shape, dtype=torch.float64)
    found = reference.at(time)
    assert found.shape == (*shape, 6)
    step = 1e-6
    slope = (reference.at(time + step) - reference.at(time - step)) / (2 * step)
    torch.testing.assert_close(found[..., 3:], slope[..., :3], rtol=1e-6, atol=1e-6)
    assert reference.at(time.float()).dtype is torch.float32


def test_a_circle_is_flown_at_its_speed():
    circle = Circle(radius=2.0, speed=0.8)
    found = circle.at(torch.linspace(0, 20, 50, dtype=torch.float64))
    ones = torch.ones(50, dtype=torch.float64)
    torch.testing.assert_close(found[:, :3].norm(dim=-1), 2 * ones)
    torch.testing.assert_close(found[:, 3:].norm(dim=-1), 0.8 * ones)


def test_a_figure_of_eight_crosses_its_centre():
    middle = FigureEight(period=6.0).at(torch.tensor([0.0, 3.0, 6.0], dtype=torch.float64))
    torch.testing.assert_close(middle[:, :3], torch.zeros(3, 3, dtype=torch.float64))
    assert middle[0, 3] > 0 > middle[1, 3]


def write(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]))
    return path


def test_a_file_with_velocities_is_read_as_it_is(tmp_path):
    rows = [[0, 0, 0, 1, 1, 0, 0], [2, 2, 0, 1, 3, 0, 0]]
    reference = find_reference(str(write(tmp_path / "line.csv", "t,x,y,z,vx,vy,vz", rows)))
    assert reference.name == "line"
    found = reference.at(torch.tensor([-1.0, 0.5, 2.0, 9.0]))
    assert found[:, 0].tolist() == [0, 0.5, 2, 2]
    assert found[:, 3].tolist() == [1, 1.5, 3, 3]


@refused(
    ("t,x,y,z,vx,vy,vz", [[0] * 7] * 2, "times that increase"),
    ("t,x,y,z,vx,vy,vz", [[0] * 7], "1 times"),
    ("t,x,y,z", [[0, 0, 0, 0]], "the first line is t,x,y,z, expected t,x,y,z,vx,vy,vz"),
)
def test_files_that_cannot_be_used_say_why(header, rows, tmp_path):
    path = write(tmp_path / "bad.csv", header, rows)
    load_reference(path)


def test_rows_that_do_not_fit_are_refused():
    with pytest.raises(ConfigurationError, match=r"\(N, 3\) each"):
        SampledReference(torch.arange(2.0), torch.zeros(2, 3), torch.zeros(2, 2))


def test_each_flight_follows_its_own_reference():
    index, time = torch.tensor([[0, 3], [1, 2]]), torch.rand(2, 2, 5)
    found = references_at(ALL, index, time)
    assert found.shape == (2, 2, 5, 6)
    assert (found[0, 1] == ALL[3].at(time[0, 1])).all()
    assert (references_at(ALL[1:2], index * 0, time) == ALL[1].at(time)).all()


@pytest.mark.parametrize("name", ["hover", "circle_2m_0.3mps", "circle_10.5m_0mps", "figure_8_6s"])
def test_a_reference_is_called_what_it_was_asked_for(name):
    assert find_reference(name).name == name


@pytest.mark.parametrize(
    "name", ["circle", "circle_2m", "circle_-1m_1mps", "ethz_2", "circle_2m_xmps"]
)
def test_references_that_there_are_not_are_refused(name):
    with pytest.raises(ConfigurationError, match=f"tracks='{name}': expected hover, a circle"):
        find_reference(name)


def test_the_budget_and_the_duration_both_end_a_flight():
    assert CrazyflieTrack(max_steps=5).max_steps == 5
    assert CrazyflieTrack(duration=1.0, dt=0.1).max_steps == 10
