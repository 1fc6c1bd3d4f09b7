"""The paper's figures and tables of a folder of results, as the examples make them."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from harness import program_of

from afm_rl.report import read_runs

EXAMPLE = Path(__file__).parents[2] / "examples" / "paper" / "published_figures.py"


@pytest.fixture(scope="module")
def paper():
    return program_of(EXAMPLE)


@pytest.fixture
def runs(run_folder):
    return read_runs([run_folder(tracks=("ethz_1", "ethz_2"), seeds=2)])


def test_the_tables_of_a_folder_have_what_its_missions_learnt(paper, runs):
    tables = paper["published"].__globals__
    learnt = tables["with_learning"](runs).groupby("method")["recovery"].unique()
    assert learnt["oracle"] == [0.0] and (learnt["physics"] > 100).all()
    assert next(tables["of_folders"](runs.folders)).name == "paper_claims"


def test_losses_are_means_over_missions_on_their_way(paper):
    loss = [1.0, 3.0, 5.0, 7.0, np.nan]
    steps = pd.DataFrame({"mission": [0, 0, 1, 1, 1], "t": [0, 1, 0, 1, 2], "loss": loss})
    missions = pd.DataFrame({"mission": [0, 1], "method": ["mine", "mine"]})
    assert paper["mean_loss"](steps, missions)["mine"].tolist() == [3.0, 4.0]  # 3, (3 + 5) / 2
    many = pd.DataFrame({"mission": 0, "t": range(60), "loss": 40 * [0.0] + 20 * [1.0]})
    assert paper["mean_loss"](many, missions)["mine"].tolist()[-1] == pytest.approx(1.0)


def test_changes_are_at_the_mean_step_over_missions(paper):
    active = [0, 1, 1, 0, 0, 0, 0, 1]
    steps = pd.DataFrame({"mission": 4 * [0] + 4 * [1], "t": 2 * [0, 1, 2, 3]})
    assert paper["change_steps"](steps.assign(regime_active=active)) == (2.0, 3.0)
    assert np.isnan(paper["change_steps"](steps.assign(regime_active=0))).all()


def test_paths_are_means_at_equal_shares_of_each_mission(paper):
    short, long = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 2.0], [0.5, 2.0], [1.0, 2.0]])
    mean, std = paper["mean_path"]([short, long])
    assert mean[-1] == pytest.approx([1.0, 1.0], abs=0.02) and std[-1].tolist() == [0.0, 1.0]
    assert (np.diff(mean[:, 0]) >= 0).all() and np.allclose(mean[:, 1], 1.0)


def test_each_figure_shows_what_the_paper_has(paper, runs):
    losses, bars = paper["draw_losses"](runs), paper["draw_bars"](runs)
    assert [panel.get_title() for panel in losses.axes] == ["ethz_1", "ethz_2"]
    lines = losses.axes[0].get_lines()
    assert len(lines) == 3 * 3  # a curve and two changes for each method
    heights = [bar.get_height() for bar in bars.axes[0].patches]
    assert heights[:3] == [0.25, 1.0, 1.0]  # ours: physics, adaptive, oracle
    assert 0 < heights[3] < 1 and np.isnan(heights[4:]).all()  # published: of physics alone
    paths = paper["draw_paths"](runs, (-1.0, 1.0))
    assert [panel.get_title() for panel in paths.axes[:3]] == ["physics", "adaptive", "oracle"]
    with pytest.raises(SystemExit, match=r"no mission with steps; there are"):
        paper["draw_paths"](runs, (7.0, 7.0))
