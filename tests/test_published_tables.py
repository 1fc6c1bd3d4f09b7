"""The paper's claims and tables beside ours, as the examples write them."""

from pathlib import Path

import pandas as pd
import pytest
import results
import torch
from harness import program_of
from results import tables_of

from afm_rl.correction import PaperFlow
from afm_rl.report.tables import markdown

EXAMPLE = Path(__file__).parents[1] / "examples" / "paper" / "published_tables.py"
CODED = "gate as coded"
# What the printed tables give for each claim of the text, in their order.
PRINTED = ["+34.0", "-1.5", "+15.9", "+0.047", "+10", "+9", "+12", "+5", *4 * ["-"]]


@pytest.fixture(scope="module")
def paper():
    return program_of(EXAMPLE)


@pytest.fixture(scope="module")
def ours(paper):
    """What was published, as three missions of each scenario that differ in their steps alone."""
    published = paper["published"]().replace({"method": {"afm": "afm_paper_code"}})
    missions = published.merge(pd.DataFrame({"seed": range(3)}), how="cross")
    finished = missions["steps_mean"] < 4999
    steps = missions["steps_mean"].round().astype(int) + finished * 10 * (missions["seed"] - 1)
    missions = missions.assign(success_rate=missions["success_mean"], steps=steps)
    return missions.assign(finished=finished).drop(columns=["success_mean", "steps_mean"])


@pytest.fixture(scope="module")
def tables(paper, ours):
    return paper["tables"](ours)


def claims(tables):
    return tables[0].shown.set_index("claim")


def test_the_printed_tables_have_what_the_text_claims_over_physics_alone(tables):
    shown = claims(tables)
    assert shown["its tables"].tolist() == PRINTED
    assert (shown["gate as written"] == "-").all()
    assert shown[CODED].str.partition(" ")[0].tolist() == PRINTED
    verdicts = shown[CODED].str.partition(": ")[2]
    assert verdicts["fewer steps than Physics (%)"] == "holds"
    assert verdicts["success over Online PE (points)"] == "does not hold"
    assert verdicts["success over Physics (points)"] == "holds, but less"


def test_nothing_is_said_of_one_seed_or_of_some_scenarios(paper, ours):
    alone = claims(paper["tables"](ours[ours["seed"] == 0]))[CODED]
    assert (alone.str.endswith(": one seed") | (alone == "-")).all()
    assert (claims(paper["tables"](ours[ours["track"] == "ethz_1"]))[CODED] == "-").all()


VERDICTS = {(30, 36): "holds", (30, 33): "holds, but less", (-1, 36): "undecided"}
VERDICTS |= {(-1, 33): "does not hold", (-2, -1): "does not hold"}


@pytest.mark.parametrize(("ends", "said"), VERDICTS.items())
def test_the_verdict_on_34_points_is_that_of_the_interval(paper, ends, said):
    assert paper["claims_table"].__globals__["verdict"](34.2, *ends) == said


def test_what_is_learnt_in_a_mission_shows_in_its_loss_and_its_recovery(paper):
    active = [0] * 40 + [1] * 60 + [0] * 20
    error, loss = [1e-3] * 40 + [1.0] * 25 + [1e-3] * 55, [-3.0] * 40 + [5.0] * 60 + [-3.0] * 20
    steps = pd.DataFrame({"mission": 0, "regime_active": active, "error": error, "loss": loss})
    never = steps.assign(mission=1, error=[1e-3] * 40 + [1.0] * 80)
    learnt = paper["learning"](pd.concat([steps, never]))
    assert learnt.to_dict("list") == {"loss": [5.0, 5.0], "recovery": [25.0, 60.0]}


def test_the_paper_s_tables_with_ours_beside_the_published(tables):
    names = [table.name for table in tables]
    assert names == ["paper_claims", "paper_means", "paper_ethz_1", "paper_ethz_2"]
    cells = tables[2]
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
    assert means.loc["AFM, gate as coded", "error of the flow"] == "0.250"
    assert "AFM, gate as written" not in means.index


def test_another_budget_is_not_left_unsaid(paper, ours):
    short = ours.assign(steps=ours["steps"].clip(upper=599))
    for table in paper["tables"](short):
        assert "Ours count 599: our budget was another one" in table.note


def test_other_regimes_make_no_tables(paper, ours):
    assert paper["tables"](ours.assign(method="mine")) == []
    assert len(paper["tables"](ours[ours["track"] == "ethz_2"])) == 3


def test_with_online_pe_in_afm_s_place_the_published_claims_hold_as_well(paper, ours):
    written = ours[ours["method"] == "afm_paper_code"].assign(method="afm_paper")
    found = paper["tables"](pd.concat([ours, written]))
    printed = tables_of("\n".join(markdown(table.title, table.shown) for table in found))
    null = program_of(EXAMPLE.with_name("published_null.py"))
    shown = null["table_of"](printed).set_index("claim")
    assert (shown["its Online PE"] == shown["our Online PE"]).all()  # ours are the published ones
    also = ["success over Physics (points)", "fewer steps than Physics (%)"]
    assert (shown["verdict"][also] == "holds, but also without AFM").all()
    assert shown["verdict"]["success over Online PE (points)"] == "does not hold"
    assert shown["verdict"]["AFM+DR: fewer steps than AFM"] == "-"  # not run


@pytest.mark.parametrize(
    ("size", "cell", "null", "said"),
    [
        (10, "+12 [+11, +13]: holds", 9, "holds and is due to AFM"),
        (10, "+12 [+11, +13]: holds", 10, "holds, but also without AFM"),
        (10, "+8 [+7, +9]: holds, but less", 7, "holds, but also without AFM"),
        (0, "+2 [+1, +3]: holds", 0, "holds and is due to AFM"),
        (0, "+2 [-1, +3]: undecided", 0, "does not hold"),
        (0, "-", 0, "-"),
    ],
)
def test_a_claim_is_due_to_afm_if_the_null_does_not_reach_it(size, cell, null, said):
    program = program_of(EXAMPLE.with_name("published_null.py"))
    assert program["verdict"](size, program["effect_of"](cell), null) == said


def test_an_effect_that_cannot_be_read_is_refused():
    program = program_of(EXAMPLE.with_name("published_null.py"))
    with pytest.raises(SystemExit, match="expected an effect and its verdict"):
        program["effect_of"]("12")


def test_the_action_that_explains_a_transition_achieves_the_plan_of_reversed_motors_only():
    gate = program_of(EXAMPLE.with_name("published_gate.py"))
    flow = PaperFlow(-gate["HIGH"], gate["HIGH"], features=[2], state_size=3)
    reversed_, faster = (gate["sides"](flow, torch.tensor(g)) for g in ([-1.0, 1.0], [2.0, 2.0]))
    assert reversed_["ideal"] < 1e-6 < reversed_["right"] and reversed_["ideal holds"] == 1
    assert faster["ideal"] > faster["right"] > 0 and faster["ideal holds"] == 0
    assert reversed_["opens, wrapped"] == faster["opens, wrapped"] == 0 < faster["opens"]


STUDIES = {"flights": "quadrotor_flow", "physics": "paper_physics"}


@pytest.mark.parametrize(("study", "result"), STUDIES.items())
def test_the_tables_of_a_study_follow_from_its_missions(study, result):
    program = program_of(EXAMPLE.with_name("published_missions.py"))
    printed = markdown(study, program["table_of"](program["missions_of"](study)))
    assert tables_of(printed)[study] == results.load(result)["tables"][study]


def test_missions_as_published_are_off_by_nothing(ours, monkeypatch, tmp_path):
    program = program_of(EXAMPLE.with_name("published_missions.py"))
    monkeypatch.setitem(program["store"].__globals__, "FILE", tmp_path / "missions.csv")
    missions = ours[ours["method"] == "physics"].assign(run="as published")
    missions["regime"] = missions["scenario"].str.partition(", ")[2]
    for name, seen in (("other", missions), ("mine", missions[:9]), ("mine", missions)):
        program["store"](name, seen)
    assert len(program["missions_of"]("other")) == len(program["missions_of"]("mine")) == 66
    theirs, run = program["table_of"](program["missions_of"]("mine")).to_dict("records")
    assert run["success, off by"] == "0.000" and float(run["steps, off by"]) < 1
    assert run["success"] == theirs["success"] == "0.475"


def test_plans_of_the_paper_s_planner_cost_what_they_lead_to():
    program = program_of(EXAMPLE.with_name("published_physics.py"))
    setting, goal = program["Setting"], torch.zeros(1, 3)
    quarter = torch.tensor([[[[1.0, torch.pi / 2]] * 5]])  # in five steps a quarter of a circle
    pose = torch.tensor([[0.0, 0.0, -torch.pi / 2]])

    def cost(**settings):
        return float(program["costs"](pose, quarter, goal, setting(**settings)))

    radius = 2 / torch.pi
    angles = torch.linspace(-torch.pi / 2, 0, 6)[1:]
    x, y = radius * (1 + angles.sin()), -radius * angles.cos()
    exact = (x.square() + y.square() + angles.square()).sqrt().sum()
    assert cost(heading="arc") == pytest.approx(float(exact), rel=1e-5)
    assert cost(heading="before") > 1.001 * cost(heading="arc")
    pose[0, 2] = 3.0
    assert cost(wrapped=False) > cost()


def test_a_short_drive_reaches_the_first_targets():
    program = program_of(EXAMPLE.with_name("published_physics.py"))
    drive = program["drive"]
    drive.__globals__["BUDGET"] = 60
    missions = drive(program["Setting"](candidates=50))
    assert len(missions) == 20 and (missions["steps"] == 59).all()
    assert missions["success_rate"].between(1 / 34, 0.5).all()


def test_the_figure_of_eq_14_has_a_row_for_each_regime():
    gate = program_of(EXAMPLE.with_name("published_gate.py"))
    lines = results.load("paper_gate")["tables"]["both sides of eq. 14"]
    head, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines)
    miss, holds = gate["draw"](pd.DataFrame(rows, columns=head)).axes
    assert len(miss.patches) == 3 * 11 and len(holds.patches) == 2 * 11
    assert miss.patches[0].get_width() == 0.273 and holds.patches[0].get_width() == 7
