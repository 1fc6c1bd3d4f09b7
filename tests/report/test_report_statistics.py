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
    probability_of_improvement,
    rank_missions,
    resampled_bounds,
    summarise,
)
from afm_rl.report.tables import (
    comparison_tables,
    missing_lines,
    missing_table,
    summary_table,
)
from afm_rl.storage.measures import Measure, Measures


def rows(method, scenario, outcomes):
    """Missions of a method in a scenario: (success, steps) by seed."""
    return [
        {
            "method": method,
            "scenario": scenario,
            "track": scenario,
            "seed": seed,
            "success_rate": success,
            "steps": steps,
            "finished": success == 1.0,
            "seconds": 10.0,
        }
        for seed, (success, steps) in enumerate(outcomes)
    ]


@pytest.fixture
def missions(laps):
    table = [
        *rows("ours", "a", [(1.0, 99), (1.0, 199)]),
        *rows("ours", "b", [(0.5, 499), (1.0, 399)]),
        *rows("base", "a", [(1.0, 199), (0.5, 499)]),
        *rows("base", "b", [(0.5, 499)]),
        *rows("oracle", "a", [(1.0, 99), (1.0, 99)]),
        *rows("oracle", "b", [(1.0, 199), (0.5, 499)]),
    ]
    return count_budgets(pd.DataFrame(table), laps)


def interval(values, strata, statistic=np.mean):
    """The bounds of an estimate."""
    found = estimate("of", pd.Series(values, dtype=float), pd.Series(strata), statistic)
    return found["of_low"], found["of_high"]


def test_given_up_missions_cost_the_budget_of_their_cell(laps):
    table = [*rows("a", "x", [(0.5, 50), (0.5, 80), (1.0, 30)]), *rows("a", "y", [(0.5, 60)])]
    missions = count_budgets(pd.DataFrame(table), laps)
    assert missions["steps"].tolist() == [80, 80, 30, 60]
    first, second = budget_notes(pd.DataFrame(table), laps)
    assert first.startswith("3 of 4 missions did not finish within their budget and count as 60 ")
    assert "do not compare with those of results under another budget" in first
    assert second.startswith("x: missions were given up after 50 to 80 steps")
    assert budget_notes(pd.DataFrame(rows("a", "x", [(1.0, 30)])), laps) == []


def test_the_console_and_the_report_give_the_same_interval(missions, laps):
    short, long = summarise(missions, laps), aggregate(missions, laps, "oracle")
    for column in ("success_rate_low", "success_rate_high", "steps_low", "steps_high"):
        pd.testing.assert_series_equal(short[column], long[column])
    plain = scipy.stats.bootstrap(
        (missions.loc[missions["method"] == "ours", "steps"].to_numpy(),),
        np.mean,
        method="percentile",
        rng=0,
    )
    low, high = plain.confidence_interval  # what differs between scenarios would count as spread
    assert high - low > 1.2 * (short.loc[0, "steps_high"] - short.loc[0, "steps_low"])


def test_success_comes_first_and_fewer_steps_break_ties(laps):
    table = rows("a", "x", [(0.5, 90), (1.0, 80), (1.0, 30), (0.25, 90), (1.0, 80)])
    assert rank_missions(pd.DataFrame(table), laps)["rank"].tolist() == [1, 2, 3, 0, 2]


def test_pairs_share_cell_and_seed(missions, laps):
    pairs = pair(missions, "ours", "base")
    assert pairs[["scenario", "seed"]].to_numpy().tolist() == [["a", 0], ["a", 1], ["b", 0]]
    assert (pairs["steps"] - pairs["steps_other"]).tolist() == [-100, -300, 0]


def test_one_stratum_is_the_plain_bootstrap():
    sample = np.random.default_rng(3).gamma(2.0, size=40)
    for statistic in (np.mean, interquartile_mean):
        expected = scipy.stats.bootstrap(
            (sample,), statistic, method="percentile", n_resamples=20_000
        ).confidence_interval
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


def test_improvement_is_mann_whitney_s_u_in_each_cell():
    rng = np.random.default_rng(1)
    frames = [
        pd.DataFrame({"scenario": rng.choice(["a", "b"], 30), "rank": rng.integers(0, 6, 30)})
        for _ in range(2)
    ]
    expected = []
    for scenario in "ab":
        x, y = (frame.loc[frame["scenario"] == scenario, "rank"] for frame in frames)
        expected.append(scipy.stats.mannwhitneyu(x, y).statistic / (len(x) * len(y)))
    found, (low, high) = probability_of_improvement(*frames)
    assert found == pytest.approx(np.mean(expected))
    assert 0 < low < found < high < 1
    back, _ = probability_of_improvement(*frames[::-1])
    assert back == pytest.approx(1 - found)


def test_improvement_s_interval_is_that_of_draws_one_by_one():
    rng = np.random.default_rng(2)
    x, y = rng.normal(0.5, 1, 10).round(1), rng.normal(0, 1, 8).round(1)
    mine, other = (pd.DataFrame({"scenario": "a", "rank": values}) for values in (x, y))
    drawn = []
    for _ in range(4000):
        pairs = rng.choice(x, len(x))[:, None] - rng.choice(y, len(y))
        drawn.append((0.5 * (np.sign(pairs) + 1)).mean())
    _, found = probability_of_improvement(mine, other)
    np.testing.assert_allclose(found, np.quantile(drawn, [0.025, 0.975]), atol=0.03)


def test_aggregates_are_those_found_by_hand(missions, laps):
    means = aggregate(missions, laps, "oracle").set_index("method")
    ours = means.loc["ours"]
    assert (ours["missions"], ours["scenarios"], ours["finished"]) == (4, 2, 0.75)
    assert ours["success_rate"] == 0.875
    assert ours["steps"] == (99 + 199 + 499 + 399) / 4
    assert ours["success_rate_iqm"] == 1.0
    assert ours["steps_iqm"] == (199 + 399) / 2
    assert ours["per_hour"] == 360
    assert ours["ratio_pairs"] == 3 and ours["ratio_all_pairs"] == 4
    assert ours["ratio"] == pytest.approx((1 * 2 * 2.5) ** (1 / 3))
    assert ours["ratio_all"] == pytest.approx((1 * 2 * 2.5 * 0.8) ** (1 / 4))
    assert means.loc["base", "ratio_all_pairs"] == 3
    assert means.loc["oracle", "ratio"] == 1.0
    # Two seeds in each scenario: the four means of success are 0.75, 0.875 and 1.
    assert (ours["success_rate_low"], ours["success_rate_high"]) == (0.75, 1.0)


def test_the_table_of_aggregates_is_bold_for_the_best_but_the_oracle(missions, laps):
    last = pd.DataFrame(rows("base", "b", [(0.5, 499)])).assign(seed=1)
    spared = pd.DataFrame(rows("spared", "a", [(1.0, 9)]))
    whole = count_budgets(pd.concat([missions, last, spared], ignore_index=True), laps)
    means = aggregate(whole, laps, "oracle")
    table = summary_table(means, laps, "oracle")
    assert table.shown["method"].tolist() == ["ours", "base", "oracle", "spared"]
    assert table.shown.loc[0, "success (%)"] == "87.5 [75.0, 100.0]"
    assert "(n = 3)" in table.shown.loc[0, "steps / oracle, where it finished"]
    assert {row for row, _ in table.bold} == {0}
    assert {column for _, column in table.bold} == {2, 3, 4, 5, 6, 7, 8}


def test_missions_per_hour_are_those_whose_time_was_counted(missions, laps):
    some = missions.assign(seconds=[36.0] * 3 + [np.nan] + [10.0] * 7)
    means = aggregate(some, laps, "oracle").set_index("method")
    assert means["per_hour"].to_dict() == {"ours": 100.0, "base": 360.0, "oracle": 360.0}
    timeless = aggregate(missions.drop(columns="seconds"), laps, "oracle")
    assert timeless["per_hour"].isna().all()


def test_differences_are_paired(missions, laps):
    numbers = compare(missions, laps, ["base", "nobody"])
    assert numbers["method"].tolist() == ["ours", "oracle"]
    ours = numbers.iloc[0]
    assert ours["pairs"] == 3
    assert ours["success_rate"] == pytest.approx(0.5 / 3)
    assert ours["steps"] == pytest.approx(-400 / 3)
    # Cell a: 99 beats both, 199 ties once and wins once. Cell b: 0.5 ties, 1.0 wins.
    assert ours["better"] == pytest.approx((3.5 / 4 + 1.5 / 2) / 2)
    (table,) = comparison_tables(numbers, laps)
    assert table.name == "against_base"
    assert table.shown.loc[0, "n pairs"] == "3"
    assert table.shown.loc[0, "steps"].startswith("-133 [-")
    assert (0, 3) in table.bold  # the interval of steps lies below 0


def test_a_cell_shared_without_a_seed_has_no_pairs(missions, laps):
    apart = missions[missions["method"] != "oracle"]
    apart = apart.assign(seed=apart["seed"].where(apart["method"] == "ours", 7))
    (table,) = comparison_tables(
        compare(apart.drop_duplicates(["method", "scenario"]), laps, ["base"]), laps
    )
    assert table.shown.iloc[0, 1:4].tolist() == ["0", "-", "-"]
    assert table.shown.loc[0, "P(better)"] == "0.75"


def test_what_is_missing_is_counted():
    rows = [("ours", "a", 5), ("base", "a", 5), ("base", "b", 5), ("on", "a", 0), ("on", "b", 0)]
    missing = pd.DataFrame(rows, columns=["method", "scenario", "seed"])
    table = missing_table(missing, scenarios=2)
    assert table.numbers is missing and table.shown["missions"].tolist() == ["1", "2", "2"]
    assert missing_lines(table) == [
        "missing: ours: 1 missions, seeds 5, scenarios a",
        "missing: base: 2 missions, seeds 5, scenarios all 2",
        "missing: on: 2 missions, seeds 0, scenarios all 2",
    ]


def test_missions_without_a_value_are_left_out_of_its_mean():
    late = Measures((Measure("recovery", "recovery", "recovery", "steps", "lower"),))
    values = {"recovery": [3.0, np.nan, 5.0], "finished": True, "scenario": "a", "seed": [0, 1, 2]}
    missions = pd.DataFrame({"method": "x", "track": "a"} | values)
    (row,) = aggregate(missions, late, "x").to_dict("records")
    assert row["recovery"] == 4.0 and row["recovery_low"] == 3.0
    empty = missions.assign(recovery=np.nan)
    table = summary_table(aggregate(empty, late, "x"), late, "x")
    assert table.shown["recovery (steps)"].tolist() == ["-"]
