"""What the figures of joined results show."""

import numpy as np
import pandas as pd
import pytest

from afm_rl.report import read_runs
from afm_rl.report.figures import read_excerpts, share_reached, telling_scenarios
from afm_rl.report.statistics import count_budgets


@pytest.fixture
def joined(run_folder, laps):
    """Results of a run's folder: missions, the runs, recovery times and progress."""

    def make(**chosen):
        runs = read_runs([run_folder(**chosen)])
        return count_budgets(runs.missions, laps), runs, *read_excerpts(runs)

    return make


def test_before_the_first_step_logged_nothing_is_known_but_the_first():
    steps = pd.DataFrame({"t": [5, 6], "reached": [1, 2]})
    mission, grid = pd.Series({"reached": 2, "targets": 2}), np.array([0.0, 5.0, 7.0])
    assert share_reached(steps, mission, grid, ("reached", "targets")).tolist() == [0.5, 0.5, 1.0]


def test_recovery_is_gathered_for_every_mission(joined):
    _, _, times, _ = joined(seeds=2)
    assert set(times["method"]) == {"physics", "adaptive", "oracle"}
    oracle = times[(times["method"] == "oracle") & (times["of"] == "model")]
    assert oracle["time"].eq(0).all() and oracle["change"].tolist() == [1, 2, 1, 2]


def test_curves_and_maps_show_where_methods_differ_most(joined, laps):
    missions, *_ = joined(v_gains=range(2, 8))
    success = (missions["method"] == "physics") * missions["v_gain"] / 10
    chosen = telling_scenarios(missions.assign(success_rate=success), laps)
    assert chosen == [f"ring, v_gain = {gain}" for gain in (4, 5, 6, 7)]
