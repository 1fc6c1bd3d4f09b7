"""The paper's claims and tables beside ours, as the examples write them."""

import runpy
from pathlib import Path

import pandas as pd
import pytest

EXAMPLE = Path(__file__).parents[1] / "examples" / "paper" / "published_tables.py"
CODED = "gate as coded"
PRINTED = {  # of the text's claims, what the printed tables give
    "success over Physics (points)": "+34.0",
    "success over Online PE (points)": "-1.5",
    "fewer steps than Physics (%)": "+15.9",
    "fewer steps than Online PE (%)": "-0.3",
    "variance of success, less than Physics": "+0.047",
    "out of time, less often than Physics": "+10",
    "Online PE is worst": "+9",
    "best, more often than Online PE": "+12",
    "ahead of Online PE, not behind": "+5",
    "AFM+DR: success over AFM (points)": "-",
    "AFM+DR: fewer steps than AFM": "-",
    "loss, lower than Online PE's": "-",
    "back at the nominal level, steps sooner": "-",
}


@pytest.fixture(scope="module")
def paper():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE.parent))
        return runpy.run_path(str(EXAMPLE))


@pytest.fixture
def ours(paper):
    """What was published, as three missions of each scenario that differ in their steps alone."""
    published = paper["published"]().rename(columns={"method": "printed"})
    labels = pd.DataFrame(paper["LABELS"].items(), columns=["method", "printed"])
    means = published.merge(labels[labels["method"] != "afm_paper"])
    missions = means.merge(pd.DataFrame({"seed": range(3)}), how="cross")
    finished = missions["steps_mean"] < 4999
    steps = missions["steps_mean"].round().astype(int) + finished * 10 * (missions["seed"] - 1)
    columns = ["method", "track", "v_gain", "omega_gain", "seed", "scenario"]
    return missions[columns].assign(
        success_rate=missions["success_mean"], steps=steps, finished=finished
    )


def claims(paper, missions):
    return paper["tables"](missions)[0].shown.set_index("claim")


def test_the_published_figures_are_those_of_the_paper(paper):
    figures = paper["published"]()
    assert len(figures) == 5 * 22 and set(figures["method"]) <= set(paper["LABELS"].values())


def test_the_printed_tables_have_what_the_text_claims_over_physics_alone(paper, ours):
    shown = claims(paper, ours)
    assert shown["its tables"].to_dict() == PRINTED
    assert (shown["gate as written"] == "-").all()
    assert shown[CODED].str.partition(" ")[0].to_dict() == PRINTED
    verdicts = shown[CODED].str.partition(": ")[2]
    assert verdicts["fewer steps than Physics (%)"] == "holds"
    assert verdicts["success over Online PE (points)"] == "does not hold"
    assert verdicts["success over Physics (points)"] == "holds, but less"


def test_nothing_is_said_of_one_seed_or_of_some_scenarios(paper, ours):
    alone = claims(paper, ours[ours["seed"] == 0])[CODED]
    assert (alone.str.endswith(": one seed") | (alone == "-")).all()
    assert (claims(paper, ours[ours["track"] == "ethz_1"])[CODED] == "-").all()


@pytest.mark.parametrize(
    ("low", "high", "size", "said"),
    [
        (30.0, 36.0, 34.2, "holds"),
        (30.0, 33.0, 34.2, "holds, but less"),
        (-1.0, 36.0, 34.2, "cannot be told"),
        (-1.0, 33.0, 34.2, "does not hold"),
        (-2.0, -1.0, 0.0, "does not hold"),
        (-1.0, 1.0, 0.0, "cannot be told"),
        (1.0, 2.0, 0.0, "holds"),
    ],
)
def test_the_verdict_is_that_of_the_interval(paper, low, high, size, said):
    assert paper["claims_table"].__globals__["verdict"](size, low, high) == said


def test_a_method_that_is_ahead_where_it_matters(paper, ours):
    """Where AFM needs half of Online PE's steps, it is ahead in all scenarios that it finishes."""
    online = ours[ours["method"] == "online_pe"].set_index(["scenario", "seed"])
    mine = (ours["method"] == "afm_paper_code") & ours["finished"]
    half = online["steps"].reindex(pd.MultiIndex.from_frame(ours[["scenario", "seed"]])) / 2
    shown = claims(paper, ours.assign(steps=ours["steps"].where(~mine, half.to_numpy())))
    assert shown.loc["fewer steps than Online PE (%)", CODED].endswith(": holds")
    assert shown.loc["Online PE is worst", CODED].startswith("+9")


def test_what_is_learnt_in_a_mission_shows_in_its_loss_and_its_recovery(paper):
    active = [0] * 40 + [1] * 60 + [0] * 20
    error, loss = [1e-3] * 40 + [1.0] * 25 + [1e-3] * 55, [-3.0] * 40 + [5.0] * 60 + [-3.0] * 20
    steps = pd.DataFrame({"regime_active": active, "error": error, "loss": loss})
    never = steps.assign(error=[1e-3] * 40 + [1.0] * 80, mission=1)
    learnt = paper["learning"](pd.concat([steps.assign(mission=0), never]))
    assert learnt["loss"].tolist() == [5.0, 5.0]
    assert learnt["recovery"].tolist() == [25.0, 4999.0]


def test_the_paper_s_tables_with_ours_beside_the_published(paper, ours):
    names = [table.name for table in paper["tables"](ours)]
    assert names == ["paper_claims", "paper_means", "paper_ethz_1", "paper_ethz_2"]
    cells = paper["tables"](ours)[2]
    row = cells.shown.set_index("regime").loc["1, -1"]
    assert row["Physics (published)"] == "1.00/827 (1.00/827)"
    assert row["AFM, gate as written"] == "-"
    assert row["AFM, gate as coded (published)"] == "1.00/1826 (1.00/1826)"
    assert "ours: 3" in cells.note and "another one" not in cells.note


def test_the_means_and_how_often_time_runs_out(paper, ours):
    means = paper["tables"](ours.assign(flow_error=0.25))[1].shown.set_index("method")
    assert means.loc["Physics", ["success, ours", "success, published"]].tolist() == ["0.475"] * 2
    late = means[["out of time, ours", "out of time, published"]]
    assert late.loc["AFM, gate as coded"].tolist() == late.loc["Online PE"].tolist() == ["5", "5"]
    assert late.loc["Physics"].tolist() == ["15", "15"]
    assert means.loc["AFM, gate as coded", "error of the flow"] == "0.25"
    assert "AFM, gate as written" not in means.index


def test_another_budget_is_not_left_unsaid(paper, ours):
    short = ours.assign(steps=ours["steps"].clip(upper=599))
    for table in paper["tables"](short):
        assert "Ours count 599: our budget was another one" in table.note


def test_other_regimes_make_no_tables(paper, ours):
    assert paper["tables"](ours.assign(method="mine")) == []
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
