"""What the figures of joined results show."""

import warnings

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from afm_rl.report import style, write_run
from afm_rl.report.aggregate import aggregate
from afm_rl.report.bars import draw_bars
from afm_rl.report.collect import collect
from afm_rl.report.gather import gather, share_reached
from afm_rl.report.heatmaps import heat_figures, mapped_cells
from afm_rl.report.outcomes import add_outcomes
from afm_rl.report.profile import draw_profile, ratios
from afm_rl.report.progress import draw_progress
from afm_rl.report.scenarios import scenario_figures, traced_missions
from afm_rl.report.style import method_styles, png_bytes

NOTHING = pd.DataFrame(columns=["seconds", "missions"])


@pytest.fixture
def joined(tmp_path, make_results):
    """Results of a run's folder: missions with outcomes, and excerpts of their steps."""

    def make(drop=(), spoil=lambda steps: steps, **chosen):
        missions, steps = make_results(**chosen)
        quiet = {"figures": False, "tensorboard": False, "echo": lambda line: None}
        write_run(tmp_path / "run", missions, spoil(steps.drop(columns=list(drop))), **quiet)
        collection = collect([tmp_path / "run"])
        found = add_outcomes(collection.missions)
        traced = traced_missions(found)
        return found, traced, gather(collection, traced["mission"], mapped_cells(found))

    return make


def texts(figure):
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def all_figures(missions, traced, gathered, tracks=()):
    styles = method_styles(missions["method"])
    yield draw_bars(aggregate(missions, NOTHING, "oracle"), styles)
    yield draw_profile(missions, styles)
    yield draw_progress(gathered, styles)
    for *_, figure in scenario_figures(traced, pd.concat(gathered.traces), styles):
        yield figure
    for *_, figure in heat_figures(missions, gathered.places, tracks):
        yield figure


def test_pictures_are_whole_and_legible(joined, ring):
    with warnings.catch_warnings(action="error"):
        figures = list(all_figures(*joined(seeds=2, v_gains=[-1.0, 2.0]), [ring]))
        assert len(figures) == 6
        for figure in figures:
            png_bytes(figure)
            assert min(text.get_fontsize() for text in figure.findobj(Text)) >= 7
    assert style.DPI == 150


def test_bars_are_the_means_and_lines_the_intervals(joined, artists):
    missions, *_ = joined(methods=["physics", "oracle"], seeds=3)
    missions["success_rate"] = missions["success_rate"].where(missions["seed"] > 0, 0.1)
    means = aggregate(missions, NOTHING, "oracle")
    figure = draw_bars(means, method_styles(means["method"]))
    success, steps = figure.axes
    np.testing.assert_allclose([b.get_width() for b in success.patches], 100 * means["success"])
    np.testing.assert_allclose([bar.get_width() for bar in steps.patches], means["steps_iqm"])
    for line, row in zip(artists(success, "interval"), means.itertuples(), strict=True):
        np.testing.assert_allclose(
            line.get_xdata(), [100 * row.success_low, 100 * row.success_high]
        )
    assert "oracle (n = 3)" in texts(figure)


def test_the_profile_counts_missions_within_a_factor(joined, artists):
    missions, *_ = joined(seeds=2)
    ratio = ratios(missions).groupby(missions["method"]).agg(list)
    assert ratio["oracle"] == [1.0, 1.0]
    np.testing.assert_allclose(ratio["adaptive"], [120 / 100, 121 / 101])
    assert ratio["physics"] == [np.inf] * 2
    (axes,) = draw_profile(missions, method_styles(missions["method"])).axes
    physics, adaptive, oracle = (line.get_ydata() for line in artists(axes, "profile"))
    assert (physics == 0).all() and (oracle == 100).all()
    assert adaptive[0] == 0 and adaptive[-1] == 100


def test_a_profile_of_missions_that_nobody_finished_is_flat(joined, artists):
    missions, *_ = joined(methods=["physics"])
    (axes,) = draw_profile(missions, method_styles(missions["method"])).axes
    (line,) = artists(axes, "profile")
    assert (line.get_ydata() == 0).all()


def test_progress_is_the_mean_share_of_targets(joined, artists, make_results):
    missions, _, gathered = joined(methods=["physics", "oracle"], seeds=2)
    assert gathered.progress["oracle"].shape == (2, len(gathered.grid))
    (axes,) = draw_progress(gathered, method_styles(missions["method"])).axes
    physics, oracle = artists(axes, "progress")
    _, steps = make_results(["oracle"])
    reached = steps["reached"].to_numpy()
    for step, share in zip(oracle.get_xdata(), oracle.get_ydata(), strict=True):
        expected = 8 if step > steps["t"].max() else reached[int(step)]
        assert share == pytest.approx(100 * expected / 8)
    assert physics.get_ydata()[-1] == 25


def test_before_the_first_step_logged_nothing_is_known_but_the_first():
    steps = pd.DataFrame({"t": [5, 6], "reached": [1, 2]})
    mission = pd.Series({"reached": 2, "targets": 2})
    assert share_reached(steps, mission, np.array([0.0, 5.0, 7.0])).tolist() == [0.5, 0.5, 1.0]


def test_recovery_is_gathered_for_every_mission(joined):
    *_, gathered = joined(seeds=2)
    times = pd.concat(gathered.recovery)
    assert set(times["method"]) == {"physics", "adaptive", "oracle"}
    oracle = times[times["method"] == "oracle"]
    assert oracle["time"].eq(0).all() and oracle["change"].tolist() == [1, 2, 1, 2]


def test_one_panel_per_cell_with_all_methods(joined, artists):
    missions, traced, gathered = joined(v_gains=[-1.0, 2.0], seeds=2)
    styles = method_styles(missions["method"])
    pages = list(scenario_figures(traced, pd.concat(gathered.traces), styles))
    assert [page[0] for page in pages] == ["error_ring", "loss_ring"]
    assert [page[1] for page in pages] == ["Prediction error on ring", "Model loss on ring"]
    assert "(page 1 of 1)" in pages[0][2]
    error = pages[0][3]
    assert [axes.get_title() for axes in error.axes] == [
        "v_gain = -1 (seed 0)",
        "v_gain = 2 (seed 0)",
    ]
    for axes in error.axes:
        assert len(artists(axes, "mean")) == 3
        assert not artists(axes, "raw")
        lines = artists(axes, "mean")
        assert [line.get_marker() for line in lines] == [look.marker for look in styles.values()]


def test_many_cells_fill_several_pages(joined):
    missions, traced, gathered = joined(methods=["oracle"], v_gains=range(2, 19))
    styles, traces = method_styles(missions["method"]), pd.concat(gathered.traces)
    pages = list(scenario_figures(traced, traces, styles))
    assert [page[0] for page in pages] == [
        "error_ring_1",
        "error_ring_2",
        "loss_ring_1",
        "loss_ring_2",
    ]
    assert [len(page[3].axes) for page in pages] == [12, 5, 12, 5]
    assert pages[1][1] == "Prediction error on ring, page 2"


def test_the_changes_of_many_methods_are_marked_without_lines(joined, artists, make_results):
    missions, traced, gathered = joined(methods=["oracle"])
    many = pd.concat([traced.assign(method=f"m{k}", mission=k) for k in range(7)])
    traces = pd.concat([gathered.traces[0].assign(mission=k) for k in range(7)])
    styles = method_styles(many["method"])
    (axes,) = next(scenario_figures(many, traces, styles))[3].axes
    assert len(artists(axes, "change")) == 2 * 7  # two triangles each


def test_losses_that_nobody_has_are_not_drawn(joined):
    missions, traced, gathered = joined(spoil=lambda steps: steps.assign(loss=np.nan))
    styles, traces = method_styles(missions["method"]), pd.concat(gathered.traces)
    assert [page[0] for page in scenario_figures(traced, traces, styles)] == ["error_ring"]


def test_the_traced_seed_is_the_one_that_most_methods_have(joined):
    missions, *_ = joined(seeds=3)
    some = missions[(missions["seed"] > 0) | (missions["method"] == "oracle")]
    assert traced_missions(some)["seed"].tolist() == [1, 1, 1]


def test_maps_count_every_step_inside(joined, ring, artists):
    missions, _, gathered = joined(methods=["adaptive", "oracle"], seeds=2)
    ((name, title, _, figure),) = heat_figures(missions, gathered.places, [ring])
    assert (name, title) == ("heat_ring", "Places on ring")
    adaptive, oracle, bar = figure.axes
    for axes, count in ((adaptive, 2 * 120), (oracle, 2 * 100)):
        (mesh,) = axes.collections[-1:]
        assert mesh.get_array().sum() == count
        assert artists(axes, "road")
    assert bar.get_ylabel() == "steps in a square"


def test_a_method_missing_in_a_cell_has_an_empty_map(joined):
    missions, _, gathered = joined(methods=["adaptive", "oracle"], v_gains=[-1.0, 2.0])
    del gathered.places["ring, v_gain = 2", "oracle"]
    ((*_, figure),) = heat_figures(missions, gathered.places, [])
    assert texts(figure).count("missing") == 1


def test_maps_of_many_methods_fill_several_pages(joined):
    missions, _, gathered = joined(methods=["oracle"])
    (places,) = gathered.places.values()
    many = pd.concat([missions.assign(method=f"m{k}") for k in range(13)])
    spread = {("ring, v_gain = -1", f"m{k}"): places for k in range(13)}
    pages = list(heat_figures(many, spread, []))
    assert [len(page[3].axes) - 1 for page in pages] == [5, 4, 4]
    assert [page[0] for page in pages] == ["heat_ring_1", "heat_ring_2", "heat_ring_3"]


def test_maps_show_where_methods_differ_most(joined):
    missions, *_ = joined(v_gains=range(2, 8))
    success = (missions["method"] == "physics") * missions["v_gain"] / 10
    chosen = mapped_cells(missions.assign(success_rate=success))
    assert chosen == [f"ring, v_gain = {gain}" for gain in (4, 5, 6, 7)]


def test_robots_without_a_place_have_no_map(joined):
    missions, _, gathered = joined(drop=["x", "y"])
    assert not gathered.places
    assert list(heat_figures(missions, gathered.places, [])) == []
