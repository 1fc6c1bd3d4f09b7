"""The paper's tables beside ours."""

import numpy as np
import pandas as pd
import pytest

from afm_rl.report.frames import short_cell_names
from afm_rl.report.published import OURS, published, published_tables


@pytest.fixture
def ours():
    """Two methods under all published regimes on both tracks, three seeds."""
    regimes = published()[["track", "v_gain", "omega_gain"]].drop_duplicates()
    every = regimes.merge(pd.DataFrame({"method": ["physics", "mine"]}), how="cross")
    every = every.merge(pd.DataFrame({"seed": range(3)}), how="cross")
    every = every[["method", "track", "v_gain", "omega_gain", "seed"]]
    missions = every.assign(success_rate=[0.5, 0.75, 1.0] * 44, steps=[100, 200, 600] * 44)
    return missions.assign(cell=short_cell_names(missions))


def test_the_published_figures_are_those_of_the_paper():
    figures = published()
    assert len(figures) == 5 * 22
    assert set(figures["method"]) == set(OURS.values())
    means = figures.groupby("method")[["success_mean", "steps_mean"]].mean()
    assert means.loc["afm_paper", "success_mean"] == pytest.approx(0.8145, abs=1e-4)
    assert means.loc["online_pe", "steps_mean"] == pytest.approx(3239.7, abs=0.1)
    assert means.loc["physics", "steps_mean"] == pytest.approx(3865.2, abs=0.1)


def test_four_tables_with_ours_beside_the_published(ours):
    tables = published_tables(ours)
    assert [table.name for table in tables] == [
        "paper_ethz_1_success",
        "paper_ethz_1_steps",
        "paper_ethz_2_success",
        "paper_ethz_2_steps",
    ]
    success, steps = tables[:2]
    row = success.shown[(success.shown["v_gain"] == "1") & (success.shown["omega_gain"] == "-1")]
    assert row["physics, ours"].item() == "0.75 ± 0.20"
    assert row["physics, published"].item() == "1.00 ± 0.00"
    assert row["online_pe, ours"].item() == "-"
    assert steps.shown["physics, ours"].iloc[0] == f"300 ± {np.std([100, 200, 600]):.0f}"
    assert steps.shown["afm_paper, published"].iloc[0] == "2863 ± 170"
    assert not any("mine" in column for column in success.shown)
    assert success.numbers.groupby("method")["missions"].sum().to_dict() == {
        **dict.fromkeys(OURS.values(), 0),
        "physics": 33,
    }


def test_the_better_of_our_methods_is_bold(ours):
    second = ours[ours["method"] == "physics"].assign(method="online_pe", success_rate=1.0)
    table = published_tables(pd.concat([ours, second]))[0]
    heads = {table.shown.columns[column] for _, column in table.bold}
    assert heads == {"online_pe, ours"}
    assert len(table.bold) == 11


def test_other_regimes_make_no_tables(ours):
    assert published_tables(ours[ours["method"] == "mine"]) == []
    assert published_tables(ours.assign(cell="ethz_1, slip")) == []
    assert len(published_tables(ours[ours["track"] == "ethz_2"])) == 2
