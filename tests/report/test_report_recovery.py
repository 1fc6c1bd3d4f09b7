"""Recovery times against those that were put into the errors."""

import numpy as np
import pandas as pd
import pytest

from afm_rl.report.learning import STAY, recovery_table, recovery_times

LOW, HIGH = 1e-3, 0.5


def mission(*stretches):
    """Steps made of (regime active, error, number of steps)."""
    active = np.concatenate([np.full(n, on) for on, _, n in stretches])
    error = np.concatenate([np.full(n, size) for _, size, n in stretches])
    return pd.DataFrame({"regime_active": active, "error": error})


def times(steps):
    return recovery_times(steps).set_index("change")["time"].to_dict()


def test_the_first_step_of_the_first_quiet_stretch_counts():
    steps = mission(
        (0, LOW, 50), (1, HIGH, 13), (1, LOW, STAY), (1, HIGH, 5), (0, HIGH, 4), (0, LOW, 40)
    )
    assert times(steps) == {1: 13, 2: 4}


def test_a_short_quiet_stretch_is_no_recovery():
    steps = mission((0, LOW, 50), (1, HIGH, 9), (1, LOW, STAY - 1), (1, HIGH, 2), (1, LOW, STAY))
    assert times(steps) == {1: 9 + STAY - 1 + 2}


def test_an_error_that_never_rises_takes_no_time():
    assert times(mission((0, LOW, 50), (1, LOW, 50))) == {1: 0}


def test_an_error_that_stays_high_is_never_recovered_from():
    assert times(mission((0, LOW, 50), (1, HIGH, 50), (0, LOW, 50))) == {1: np.inf, 2: 0}


def test_stretches_too_short_to_tell_are_left_out():
    assert times(mission((0, LOW, 50), (1, LOW, STAY - 1), (0, LOW, STAY))) == {2: 0}


def test_missions_without_a_change_have_no_times():
    for active in (0, 1):
        assert recovery_times(mission((active, LOW, 50))).empty


def test_missions_without_times_may_come_first():
    parts = [mission((0, LOW, 50)), mission((0, LOW, 50), (1, HIGH, 5), (1, LOW, STAY))]
    joined = pd.concat([recovery_times(part).assign(method="a") for part in parts])
    assert recovery_table(joined).numbers["median"].tolist() == [5]
    together = pd.concat([part.assign(mission=n) for n, part in enumerate(parts)])
    pd.testing.assert_frame_equal(
        recovery_times(together), joined.drop(columns="method"), check_dtype=False
    )


def test_motion_and_agent_are_measured_where_they_were_logged():
    steps = mission((0, LOW, 50), (1, HIGH, 50)).assign(miss=LOW)
    found = recovery_times(steps).set_index("of")["time"].to_dict()
    assert found == {"motion": 0, "model": np.inf}
    steps["unforeseen"] = np.where(np.arange(100) < 57, steps["error"], LOW)
    found = recovery_times(steps).set_index("of")["time"].to_dict()
    assert found == {"motion": 0, "agent": 7, "model": np.inf}
    blind = steps.assign(miss=np.nan, unforeseen=np.nan)
    assert recovery_times(blind)["of"].tolist() == ["model"]


@pytest.mark.parametrize(("factor", "time"), [(1.4, 0), (1.6, np.inf)])
def test_the_level_is_a_high_quantile_of_the_errors_before(factor, time):
    steps = mission((0, LOW, 96), (0, HIGH, 4), (1, factor * LOW, 50))
    assert times(steps) == {1: time}  # 4 of 100 outliers do not matter


def test_a_lucky_step_is_no_recovery():
    steps = mission((0, LOW, 50), (1, HIGH, 3), (1, LOW, 1), (1, HIGH, 5), (1, LOW, STAY))
    assert times(steps) == {1: 9}


def test_errors_below_the_floor_are_all_the_same():
    assert times(mission((0, 1e-6, 50), (1, 0.9e-4, 50))) == {1: 0}


def test_missions_never_recovered_count_in_the_median():
    what = {"of": "model", "change": 1}
    time = [3.0, np.inf, 5.0, np.inf, np.inf]
    frame = pd.DataFrame({"method": "a", **what, "time": time})
    other = pd.DataFrame({"method": "b", **what, "time": [3.0, 5.0, 9.0]})
    table = recovery_table(pd.concat([frame, other]))
    assert table.numbers["never"].tolist() == [0.6, 0.0]
    assert table.numbers["median"].tolist() == [np.inf, 5.0]
    assert table.shown["never %"].tolist() == ["60", "0"]
    assert table.shown["median steps"].tolist() == ["∞", "5"]
    assert table.shown["quartiles"].tolist() == ["5 to ∞", "3 to 5"]
