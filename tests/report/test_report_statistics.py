"""Numbers of the joined tables against those found by hand and by scipy."""

import math

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from afm_rl.report.statistics import (
    aggregate,
    budget_notes,
    compare,
    count_budgets,
    estimate,
    interquartile_mean,
    pair,
    resampled_bounds,
)
from afm_rl.report.tables import comparison_tables, missing_table, summary_table
from afm_rl.storage.measures import Measure, Measures


def rows(method, scenario, *outcomes):
    """Missions of a method in a scenario: (success, steps) by seed."""
    table = pd.DataFrame(outcomes, columns=["success_rate", "steps"])
    table = table.assign(method=method, scenario=scenario, track=scenario, seed=table.index)
    return table.assign(finished=table["success_rate"] == 1.0, seconds=10.0)


@pytest.fixture
def missions(laps):
    table = [
        rows("ours", "a", (1.0, 99), (1.0, 199)),
        rows("ours", "b", (0.5, 499), (1.0, 399)),
        rows("base", "a", (1.0, 199), (0.5, 499)),
        rows("base", "b", (0.5, 499)),
        rows("oracle", "a", (1.0, 99), (1.0, 99)),
        rows("oracle", "b", (1.0, 199), (0.5, 499)),
    ]
    return count_budgets(pd.concat(table, ignore_index=True), laps)


def interval(values, strata, statistic=np.mean):
    """The bounds of an estimate."""
    found = estimate("of", pd.Series(values, dtype=float), pd.Series(strata), statistic)
    return found["of_low"], found["of_high"]


def test_given_up_missions_cost_the_budget_of_their_cell(laps):
    table = pd.concat([rows("a", "x", (0.5, 50), (0.5, 80), (1.0, 30)), rows("a", "y", (0.5, 60))])
    missions = count_budgets(table, laps)
    assert missions["steps"].tolist() == [80, 80, 30, 60]
    (note,) = budget_notes(table, laps)
    assert note.startswith("3 of 4 missions did not finish within their budget and count as 60 ")
    assert "60 steps or 80 steps, the largest budget of their scenario" in note
    assert "Do not compare such numbers with results under another budget" in note
    assert budget_notes(rows("a", "x", (1.0, 30)), laps) == []


def test_pairs_share_cell_and_seed(missions, laps):
    pairs = pair(missions, "ours", "base")
    assert pairs[["scenario", "seed"]].to_numpy().tolist() == [["a", 0], ["a", 1], ["b", 0]]
    assert (pairs["steps"] - pairs["steps_other"]).tolist() == [-100, -300, 0]


def test_one_stratum_is_the_plain_bootstrap():
    sample = np.random.default_rng(3).gamma(2.0, size=40)
    for statistic in (np.mean, interquartile_mean):
        how = {"method": "percentile", "n_resamples": 20_000}
        expected = scipy.stats.bootstrap((sample,), statistic, **how).confidence_interval
        found = interval(sample, np.zeros(40), statistic)
        np.testing.assert_allclose(found, expected, rtol=0.04)


def test_intervals_hold_the_mean_as_often_as_they_say():
    rng, held, means = np.random.default_rng(0), 0, np.array([0.0, 5.0, 20.0, 3.0])
    strata = np.repeat(np.arange(4), 12)
    for _ in range(200):
        sample = means[strata] + rng.normal(size=len(strata))
        low, high = interval(sample, strata)
        held += low <= means.mean() <= high
        assert high - low < 1.0  # what differs between scenarios is no spread
    assert 0.88 <= held / 200 <= 0.99


def test_no_draw_that_differs_no_interval():
    for values, strata in (([1.0, 2.0], ["a", "b"]), ([3.0, 3.0], ["a", "a"]), ([], [])):
        assert all(map(math.isnan, interval(values, strata)))


def test_bounds_of_a_curve_are_those_of_each_of_its_points():
    rng = np.random.default_rng(4)
    samples = [rng.normal(size=(size, 3)) for size in (5, 1, 8)]
    found = resampled_bounds(samples, lambda parts: np.concatenate(parts, -1).mean(-1))
    strata = np.repeat([0, 1, 2], [5, 1, 8])
    points = [interval(column, strata) for column in np.concatenate(samples).T]
    assert found.shape == (2, 3)
    np.testing.assert_allclose(found.T, points, atol=0.06)


def test_the_interquartile_mean_cuts_a_quarter_on_each_side():
    values = np.array([9.0, 1.0, 2.0, 3.0, 4.0, 100.0, -50.0, 0.0])
    assert interquartile_mean(values) == np.sort(values)[2:6].mean()
    assert interquartile_mean(np.stack([values, values + 1])).tolist() == [2.5, 3.5]


def test_aggregates_are_those_found_by_hand(missions, laps):
    means = aggregate(missions, laps).set_index("method")
    ours = means.loc["ours"]
    assert (ours["missions"], ours["scenarios"], ours["finished"]) == (4, 2, 0.75)
    assert ours["success_rate"] == 0.875
    assert ours["steps"] == (99 + 199 + 499 + 399) / 4
    assert ours["success_rate_iqm"] == 1.0
    assert ours["steps_iqm"] == (199 + 399) / 2
    assert ours["seconds"] == 40.0
    # Two seeds in each scenario: the four means of success are 0.75, 0.875 and 1.
    assert (ours["success_rate_low"], ours["success_rate_high"]) == (0.75, 1.0)


def test_the_table_of_aggregates_is_bold_for_the_best_but_the_oracle(missions, laps):
    last = rows("base", "b", (0.5, 499)).assign(seed=1)
    spared = rows("spared", "a", (1.0, 9))
    whole = count_budgets(pd.concat([missions, last, spared], ignore_index=True), laps)
    means = aggregate(whole, laps)
    table = summary_table(means, laps, "oracle")
    assert table.shown["method"].tolist() == ["ours", "base", "oracle", "spared"]
    assert table.shown.loc[0, "success (%)"] == "87.5 [75.0, 100.0]"
    assert {row for row, _ in table.bold} == {0}
    assert {column for _, column in table.bold} == {2, 3, 4, 5, 6}


def test_differences_are_paired(missions, laps):
    numbers = compare(missions, laps, ["base", "nobody"])
    assert numbers["method"].tolist() == ["ours", "oracle"]
    ours = numbers.iloc[0]
    assert ours["pairs"] == 3
    assert ours["success_rate"] == pytest.approx(0.5 / 3)
    assert ours["steps"] == pytest.approx(-400 / 3)
    (table,) = comparison_tables(numbers, laps)
    assert table.name == "against_base"
    assert table.shown.loc[0, "n pairs"] == "3"
    assert table.shown.loc[0, "steps"].startswith("-133 [-")
    assert (0, 3) in table.bold  # the interval of steps lies below 0


def test_a_cell_shared_without_a_seed_is_no_comparison(missions, laps):
    apart = missions[missions["method"] != "oracle"]
    apart = apart.assign(seed=apart["seed"].where(apart["method"] == "ours", 7))
    assert comparison_tables(compare(apart, laps, ["base"]), laps) == []


def test_what_is_missing_is_counted():
    rows = [("ours", "a", 5), ("base", "a", 5), ("base", "b", 5), ("on", "a", 0), ("on", "b", 0)]
    missing = pd.DataFrame(rows, columns=["method", "scenario", "seed"])
    table = missing_table(missing, scenarios=2)
    assert table.numbers is missing and table.shown["missions"].tolist() == ["1", "2", "2"]
    assert table.shown["seeds"].tolist() == ["5", "5", "0"]
    assert table.shown["scenarios"].tolist() == ["a", "all 2", "all 2"]


def test_missions_without_a_value_are_left_out_of_its_mean():
    late = Measures((Measure("recovery", "recovery", "recovery", "steps", "lower"),))
    values = {"recovery": [3.0, np.nan, 5.0], "finished": True, "scenario": "a", "seed": [0, 1, 2]}
    missions = pd.DataFrame({"method": "x", "track": "a"} | values)
    (row,) = aggregate(missions, late).to_dict("records")
    assert row["recovery"] == 4.0 and row["recovery_low"] == 3.0
    empty = missions.assign(recovery=np.nan)
    table = summary_table(aggregate(empty, late), late, "x")
    assert table.shown["recovery (steps)"].tolist() == ["-"]
