"""What reports read out of the data frames."""

import pandas as pd
import pytest

from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.report.frames import (
    cell_names,
    check_frames,
    first_missions,
    left_out,
    regime_names,
)


def test_parameters_of_any_regime_are_found():
    missions = pd.DataFrame(columns=["mission", "method", "track", "mass", "wind_x", "seed"])
    assert regime_names(missions) == ["mass", "wind_x"]
    assert regime_names(pd.DataFrame(columns=["method", "track", "seed"])) == []


def test_a_cell_is_a_track_and_a_regime(make_results):
    missions, _ = make_results(["oracle"], v_gains=[-1.0, 0.05], seeds=2, tracks=["ring", "oval"])
    assert cell_names(missions).unique().tolist() == [
        "ring, v_gain = -1",
        "ring, v_gain = 0.05",
        "oval, v_gain = -1",
        "oval, v_gain = 0.05",
    ]


def test_a_regime_goes_by_the_name_it_was_given(make_results):
    missions, _ = make_results(["oracle"], v_gains=[-1.0, 0.05])
    named = missions.assign(regime="slip")
    assert cell_names(named).unique().tolist() == ["ring, slip"]


def test_short_names_leave_out_gains_of_one(make_results):
    missions, _ = make_results(["oracle"], v_gains=[-1.0, 1.0, 1.5, 0.1])
    assert cell_names(missions).tolist() == [
        "ring, v_gain = -1",
        "ring, nominal",
        "ring, v_gain = 1.5",
        "ring, v_gain = 0.1",
    ]


def test_the_first_mission_stands_for_its_method_and_cell(make_results):
    missions, _ = make_results(v_gains=[-1.0, 2.0], seeds=3)
    first = first_missions(missions)
    assert first["mission"].tolist() == [0, 3, 6, 9, 12, 15]
    assert left_out(missions, first) == "12 of 18 missions not shown"
    assert left_out(missions, missions) == ""


def test_frames_that_fit_pass(make_results, laps):
    check_frames(*make_results(), laps)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda m, s: (m.drop(columns=["seed", "steps"]), s), "missions: columns seed, steps"),
        (lambda m, s: (m, s.drop(columns="loss")), "steps: columns loss"),
        (lambda m, s: (m[:0], s), "at least one mission"),
        (lambda m, s: (m.assign(mission=0), s), "mission 0 occurs twice"),
        (lambda m, s: (m, s[s["mission"] != 1]), "no rows for mission 1"),
    ],
)
def test_frames_that_do_not_fit_are_refused(make_results, laps, spoil, message):
    with pytest.raises(ConfigurationError, match=message) as caught:
        check_frames(*spoil(*make_results()), laps)
    assert isinstance(caught.value, AFMError)
