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


CALM, QUIET = (0, LOW, 50), (1, LOW, STAY)
OUTLIERS = (0, LOW, 96), (0, HIGH, 4)  # 4 of 100
STRETCHES = {
    "the first step of the first quiet stretch counts": (
        [CALM, (1, HIGH, 13), QUIET, (1, HIGH, 5), (0, HIGH, 4), (0, LOW, 40)],
        {1: 13, 2: 4},
    ),
    "a short quiet stretch is no recovery": (
        [CALM, (1, HIGH, 9), (1, LOW, STAY - 1), (1, HIGH, 2), QUIET],
        {1: 9 + STAY - 1 + 2},
    ),
    "a lucky step neither": ([CALM, (1, HIGH, 3), (1, LOW, 1), (1, HIGH, 5), QUIET], {1: 9}),
    "what never rises takes no time": ([CALM, (1, LOW, 50)], {1: 0}),
    "what stays high is never over": ([CALM, (1, HIGH, 50), CALM], {1: np.inf, 2: 0}),
    "too short to tell is left out": ([CALM, (1, LOW, STAY - 1), (0, LOW, STAY)], {2: 0}),
    "errors below the floor are all the same": ([(0, 1e-6, 50), (1, 0.9e-4, 50)], {1: 0}),
    "outliers do not matter": ([*OUTLIERS, (1, 1.4 * LOW, 50)], {1: 0}),
    "but the level does": ([*OUTLIERS, (1, 1.6 * LOW, 50)], {1: np.inf}),
}


@pytest.mark.parametrize("case", STRETCHES)
def test_times_of_recovery(case):
    stretches, expected = STRETCHES[case]
    steps = mission(*stretches)
    assert recovery_times(steps).set_index("change")["time"].to_dict() == expected


def test_missions_without_a_change_have_no_times():
    for active in (0, 1):
        assert recovery_times(mission((active, LOW, 50))).empty


def test_missions_without_times_may_come_first():
    parts = [mission((0, LOW, 50)), mission((0, LOW, 50), (1, HIGH, 5), (1, LOW, STAY))]
    joined = pd.concat([recovery_times(part).assign(method="a") for part in parts])
    assert recovery_table(joined).numbers["median"].tolist() == [5]
    together = pd.concat([part.assign(mission=n) for n, part in enumerate(parts)])
    expected = joined.drop(columns="method")
    pd.testing.assert_frame_equal(recovery_times(together), expected, check_dtype=False)


def test_motion_and_agent_are_measured_where_they_were_logged():
    steps = mission((0, LOW, 50), (1, HIGH, 50)).assign(miss=LOW)
    found = recovery_times(steps).set_index("of")["time"].to_dict()
    assert found == {"motion": 0, "model": np.inf}
    steps["unforeseen"] = np.where(np.arange(100) < 57, steps["error"], LOW)
    found = recovery_times(steps).set_index("of")["time"].to_dict()
    assert found == {"motion": 0, "agent": 7, "model": np.inf}
    blind = steps.assign(miss=np.nan, unforeseen=np.nan)
    assert recovery_times(blind)["of"].tolist() == ["model"]


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
