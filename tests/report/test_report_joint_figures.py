"""What the figures of joined results show."""

import warnings

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from afm_rl.report.collect import collect
from afm_rl.report.figures import (
    draw_all,
    excerpts,
    share_reached,
    telling_cells,
    traced_missions,
)
from afm_rl.report.heatmaps import draw_heatmaps
from afm_rl.report.shares import draw_profile, draw_progress, ratios
from afm_rl.report.style import method_styles, png_bytes
from afm_rl.report.summary import count_budgets


@pytest.fixture
def joined(run_folder, laps):
    """Results of a run's folder: missions, the collection, and excerpts of its steps."""

    def make(**chosen):
        collection = collect([run_folder(**chosen)])
        missions = count_budgets(collection.missions, laps)
        return missions, collection, excerpts(collection, telling_cells(missions, laps))

    return make


def texts(figure):
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def test_pictures_are_whole_and_legible(joined, ring):
    with warnings.catch_warnings(action="error"):
        drawn = {name: figure for name, *_, figure in draw_all(*joined(seeds=2), [ring])}
        assert list(drawn) == ["summary", "learning_ring", "profile", "progress", "heat_ring"]
        for figure in drawn.values():
            png_bytes(figure)
            assert min(text.get_fontsize() for text in figure.findobj(Text)) >= 7


def test_the_profile_counts_missions_within_a_factor(joined, artists, laps):
    missions, *_ = joined(seeds=2)
    ratio = ratios(missions, laps.budget)
    own = ratio.groupby(missions["method"]).agg(list)
    assert own["oracle"] == [1.0, 1.0]
    np.testing.assert_allclose(own["adaptive"], [120 / 100, 121 / 101])
    assert own["physics"] == [np.inf] * 2
    styles = method_styles(missions["method"])
    (axes,) = draw_profile(missions, ratio, laps.budget, styles).axes
    physics, adaptive, oracle = (line.get_ydata() for line in artists(axes, "profile"))
    assert (physics == 0).all() and (oracle == 100).all()
    assert adaptive[0] == 0 and adaptive[-1] == 100


def test_progress_is_the_mean_share_of_targets(joined, artists, make_results):
    missions, _, found = joined(methods=["physics", "oracle"], seeds=2)
    assert found.progress["oracle"].shape == (2, len(found.grid))
    styles = method_styles(missions["method"])
    (axes,) = draw_progress(found.grid, found.progress, found.cells, styles, "targets").axes
    physics, oracle = artists(axes, "progress")
    _, steps = make_results(["oracle"])
    reached = steps["reached"].to_numpy()
    for step, share in zip(oracle.get_xdata(), oracle.get_ydata(), strict=True):
        expected = 8 if step > steps["t"].max() else reached[int(step)]
        assert share == pytest.approx(100 * expected / 8)
    assert physics.get_ydata()[-1] == 25


def test_before_the_first_step_logged_nothing_is_known_but_the_first():
    steps = pd.DataFrame({"t": [5, 6], "reached": [1, 2]})
    mission, grid = pd.Series({"reached": 2, "targets": 2}), np.array([0.0, 5.0, 7.0])
    assert share_reached(steps, mission, grid, ("reached", "targets")).tolist() == [0.5, 0.5, 1.0]


def test_recovery_is_gathered_for_every_mission(joined):
    *_, found = joined(seeds=2)
    times = pd.concat(found.recovery)
    assert set(times["method"]) == {"physics", "adaptive", "oracle"}
    oracle = times[(times["method"] == "oracle") & (times["of"] == "model")]
    assert oracle["time"].eq(0).all() and oracle["change"].tolist() == [1, 2, 1, 2]


def test_the_traced_seed_is_the_one_that_most_methods_have(joined):
    missions, *_ = joined(seeds=3)
    some = missions[(missions["seed"] > 0) | (missions["method"] == "oracle")]
    assert traced_missions(some)["seed"].tolist() == [1, 1, 1]


def test_maps_count_every_step_inside(joined, ring, artists):
    _, _, found = joined(methods=["adaptive", "oracle"], seeds=2)
    (figure,) = draw_heatmaps(found.places, ring)
    adaptive, oracle, bar = figure.axes
    for axes, count in ((adaptive, 2 * 120), (oracle, 2 * 100)):
        (mesh,) = axes.collections[-1:]
        assert mesh.get_array().sum() == count
        assert artists(axes, "road")
    assert bar.get_ylabel() == "steps in a square"


def test_a_method_missing_in_a_cell_has_an_empty_map(joined):
    _, _, found = joined(methods=["adaptive", "oracle"], v_gains=[-1.0, 2.0])
    del found.places["ring, v_gain = 2", "oracle"]
    (figure,) = draw_heatmaps(found.places)
    assert texts(figure).count("missing") == 1


def test_curves_and_maps_show_where_methods_differ_most(joined, laps):
    missions, *_ = joined(v_gains=range(2, 8))
    success = (missions["method"] == "physics") * missions["v_gain"] / 10
    chosen = telling_cells(missions.assign(success_rate=success), laps)
    assert chosen == [f"ring, v_gain = {gain}" for gain in (4, 5, 6, 7)]
