"""The quadrotor's environment as missions want it."""

import pytest

from afm_rl.envs import CrazyflieTrack, FigureEight, Hover, find_reference
from afm_rl.errors import ConfigurationError
from afm_rl.regimes import MassFactor, Schedule


def flights(tracks=("hover",), **settings):
    return CrazyflieTrack(tracks, MassFactor(), Schedule([], by="step"), **settings)


@pytest.mark.parametrize("name", ["hover", "circle_2m_0.3mps", "circle_10.5m_0mps", "figure_8_6s"])
def test_a_reference_is_called_what_it_was_asked_for(name):
    assert find_reference(name).name == name


def test_references_by_name_have_their_defaults():
    assert isinstance(find_reference("hover"), Hover)
    assert find_reference("figure_8_6s").length == FigureEight().length


def test_a_reference_may_be_a_file(tmp_path):
    path = tmp_path / "up.csv"
    path.write_text("t,x,y,z,vx,vy,vz\n0,0,0,0,0,0,1\n1,0,0,1,0,0,1\n")
    assert flights([str(path)], max_steps=3).mission_format.tracks == ("up",)


@pytest.mark.parametrize(
    "name", ["circle", "circle_2m", "circle_-1m_1mps", "ethz_2", "circle_2m_xmps"]
)
def test_references_that_there_are_not_are_refused(name):
    with pytest.raises(ConfigurationError, match=f"tracks='{name}': expected hover, a circle"):
        find_reference(name)


def test_the_budget_and_the_duration_both_end_a_flight():
    assert flights(max_steps=5).simulation.steps == 5
    assert flights(max_steps=5000).simulation.steps == 160
    assert flights(max_steps=5000, duration=1.0, dt=0.1).simulation.steps == 10


@pytest.mark.parametrize(
    ("settings", "start"),
    [
        ({}, "moving"),
        ({"preview": False}, "rest"),
        ({"preview": False, "start": "moving"}, "moving"),
        ({"start": "rest"}, "rest"),
    ],
)
def test_flights_start_as_the_protocol_has_it(settings, start):
    assert flights(max_steps=5, **settings).simulation.start == start
