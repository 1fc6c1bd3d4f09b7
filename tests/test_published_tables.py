"""The paper's tables beside ours, as the example writes them."""

import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from afm_rl.report.runs import scenario_names

EXAMPLE = Path(__file__).parents[1] / "examples" / "paper" / "published_tables.py"
STEPS = [100, 200, 4999]


@pytest.fixture(scope="module")
def paper():
    return runpy.run_path(str(EXAMPLE))


@pytest.fixture
def ours(paper):
    """Three methods under all published regimes on both tracks, three seeds."""
    regimes = paper["published"]()[["track", "v_gain", "omega_gain"]].drop_duplicates()
    methods = pd.DataFrame({"method": ["physics", "afm_paper_code", "online_pe", "mine"]})
    every = regimes.merge(methods, how="cross")
    every = every.merge(pd.DataFrame({"seed": range(3)}), how="cross")
    every = every[["method", "track", "v_gain", "omega_gain", "seed"]]
    missions = every.assign(success_rate=[0.5, 0.75, 1.0] * 88, steps=STEPS * 88)
    missions.loc[missions["method"] == "online_pe", "steps"] -= [30, 0, 0] * 22
    return missions.assign(scenario=scenario_names(missions), finished=missions["steps"] < 4999)


def test_the_published_figures_are_those_of_the_paper(paper):
    figures = paper["published"]()
    assert len(figures) == 5 * 22 and set(figures["method"]) <= set(paper["LABELS"].values())
    means = figures.groupby("method")[["success_mean", "steps_mean"]].mean()
    assert means.loc["afm", "success_mean"] == pytest.approx(0.8145, abs=1e-4)
    assert means.loc["online_pe", "steps_mean"] == pytest.approx(3239.7, abs=0.1)


def test_the_paper_s_tables_with_ours_beside_the_published(paper, ours):
    names = [table.name for table in paper["tables"](ours)]
    assert names == ["paper_means", *(f"paper_table_{number}" for number in (1, 2, 3, 4))]
    means, first, _, third, _ = paper["tables"](ours)
    row = first.shown[(first.shown["v_gain"] == "1") & (first.shown["omega_gain"] == "-1")]
    assert row["Physics"].item() == f"0.75 ± 0.20 / 1766 ± {np.std(STEPS):.0f}"
    assert row["Physics, published"].item() == "1.00 ± 0.00 / 827 ± 10"
    assert row["AFM, gate as written"].item() == "-" and row["AFM, gate as coded"].item() != "-"
    assert row["AFM, published"].item() == "1.00 ± 0.00 / 1826 ± 189"
    assert {"PE", "Online PE"} <= set(third.shown) and "Physics" not in third.shown
    assert "ours: 3" in first.note and "another one" not in third.note
    assert not any("mine" in column for column in first.shown)


def test_the_means_and_their_paired_differences(paper, ours):
    means = paper["tables"](ours)[0].shown.set_index("method")
    assert means.loc["AFM, gate as coded", "steps - Online PE"].startswith("+10 [+")
    assert means.loc["AFM, gate as coded", "success - Online PE"] == "+0.000"
    assert means.loc["Online PE", "steps - Online PE"] == "-"
    assert means.loc["Physics", "success, ours"].startswith("0.750 [")
    assert means.loc["AFM, gate as written", "success, ours"] == "-"
    assert means.loc["AFM+DR", ["success, published", "steps, published"]].tolist() == [
        "0.836",
        "3131",
    ]


def test_another_budget_is_not_left_unsaid(paper, ours):
    short = ours.assign(steps=ours["steps"].clip(upper=599))
    for table in paper["tables"](short):
        assert "Ours count 599: our budget was another one" in table.note


def test_other_regimes_make_no_tables(paper, ours):
    assert paper["tables"](ours[ours["method"] == "mine"]) == []
    assert len(paper["tables"](ours[ours["track"] == "ethz_2"])) == 3


def test_the_quadrotor_s_table(paper):
    rows = [
        {"method": method, "track": f"circle_2m_{speed}mps", "seed": seed, "mse": mse * speed}
        for method, mse in (("physics", 0.12), ("online_knode", 0.1), ("afm_online_knode", 0.09))
        for speed in (0.8, 1.7)
        for seed in range(2)
    ]
    flights = pd.DataFrame(rows)
    table = paper["flights_table"](flights.assign(scenario=flights["track"])).shown.set_index(
        "method"
    )
    assert table.loc["afm_online_knode, ours", "mean change (%)"] == "-10.0"
    assert table.loc["online_knode, Jiahao et al.", "0.8 m/s"] == "0.0660"
    assert table.loc["physics, ours", "1.7 m/s"] == "0.20400"
    assert table["mean change (%)"].iloc[-1] == "-6.6"
