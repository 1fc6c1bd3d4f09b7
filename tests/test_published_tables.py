"""The paper's tables beside ours, as the example writes them."""

import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from afm_rl.report.runs import cell_names

EXAMPLE = Path(__file__).parents[1] / "examples" / "paper" / "published_tables.py"


@pytest.fixture(scope="module")
def paper():
    return runpy.run_path(str(EXAMPLE))


@pytest.fixture
def ours(paper):
    """Two methods under all published regimes on both tracks, three seeds."""
    regimes = paper["published"]()[["track", "v_gain", "omega_gain"]].drop_duplicates()
    every = regimes.merge(pd.DataFrame({"method": ["physics", "mine"]}), how="cross")
    every = every.merge(pd.DataFrame({"seed": range(3)}), how="cross")
    every = every[["method", "track", "v_gain", "omega_gain", "seed"]]
    missions = every.assign(success_rate=[0.5, 0.75, 1.0] * 44, steps=[100, 200, 4999] * 44)
    finished = missions["steps"] < 4999
    return missions.assign(cell=cell_names(missions), finished=finished)


def test_the_published_figures_are_those_of_the_paper(paper):
    figures = paper["published"]()
    assert len(figures) == 5 * 22 and set(figures["method"]) == set(paper["LABELS"].values())
    means = figures.groupby("method")[["success_mean", "steps_mean"]].mean()
    assert means.loc["afm_paper", "success_mean"] == pytest.approx(0.8145, abs=1e-4)
    assert means.loc["online_pe", "steps_mean"] == pytest.approx(3239.7, abs=0.1)


def test_four_tables_with_ours_beside_the_published(paper, ours):
    tables = paper["tables"](ours)
    assert [table.name for table in tables] == [
        f"paper_ethz_{track}_{measure}" for track in (1, 2) for measure in ("success", "steps")
    ]
    success, steps = tables[:2]
    row = success.shown[(success.shown["v_gain"] == "1") & (success.shown["omega_gain"] == "-1")]
    assert row["physics, ours"].item() == "0.75 ± 0.20"
    assert row["physics, published"].item() == "1.00 ± 0.00"
    assert row["online_pe, ours"].item() == "-"
    assert steps.shown["physics, ours"].iloc[0] == f"1766 ± {np.std([100, 200, 4999]):.0f}"
    assert steps.shown["afm_paper, published"].iloc[0] == "2863 ± 170"
    assert not any("mine" in column for column in success.shown)
    assert "4999 of 5000" in success.note and "another one" not in success.note


def test_another_budget_is_not_left_unsaid(paper, ours):
    short = ours.assign(steps=ours["steps"].clip(upper=599))
    for table in paper["tables"](short):
        assert "Ours count 599: our budget was another one" in table.note


def test_other_regimes_make_no_tables(paper, ours):
    assert paper["tables"](ours[ours["method"] == "mine"]) == []
    assert len(paper["tables"](ours[ours["track"] == "ethz_2"])) == 2
