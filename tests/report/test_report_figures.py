"""What the figures show."""

import io
import warnings

import numpy as np
import pandas as pd
import pytest
from matplotlib import _pylab_helpers
from matplotlib.colors import to_hex
from matplotlib.image import imread
from matplotlib.text import Text

from afm_rl.report import draw_comparison, draw_learning, draw_trajectories
from afm_rl.report.style import DPI, REGIME, groups_of_methods, method_styles, png_bytes
from afm_rl.report.trajectory import distance_to
from afm_rl.storage.measures import Measure, Measures


def texts(figure):
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def titles(figure):
    return [axes.get_title().strip() for axes in figure.axes]


def pixels(figure):
    return imread(io.BytesIO(png_bytes(figure)))


LAPS = Measures(
    (
        Measure("success_rate", "success", "success", "%", "higher", 100.0, headline=True),
        Measure("steps", "steps", "steps", better="lower", headline=True),
    )
)
ALL = {
    "trajectory": lambda missions, steps, ring: draw_trajectories(missions, steps, LAPS, [ring]),
    "learning": lambda missions, steps, ring: draw_learning(missions, steps, "m, rad"),
    "comparison": lambda missions, steps, ring: draw_comparison(missions, LAPS),
}


@pytest.fixture(params=ALL)
def draw(request, ring):
    return lambda missions, steps: ALL[request.param](missions, steps, ring)


def test_pictures_are_whole_legible_and_the_same_each_time(draw, make_results):
    results = make_results(seeds=2, v_gains=[-1.0, 2.0])
    with warnings.catch_warnings(action="error"):
        figure = draw(*results)
        image = pixels(figure)
    width, height = np.array(figure.get_size_inches()) * DPI
    assert image.shape[:2] == (int(height), int(width)) and DPI == 150
    edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert (edge == 1).all()  # white all round: nothing is cut off
    assert min(text.get_fontsize() for text in figure.findobj(Text)) >= 8
    assert not _pylab_helpers.Gcf.figs  # no figure stays in global memory
    assert (pixels(draw(*results)) == image).all()


def test_names_are_no_formulas(draw, make_results):
    missions, steps = make_results(["oracle"], seeds=2)
    figure = draw(missions.assign(method="$x_{$ y", track="_$\\frac$"), steps)
    png_bytes(figure)


def test_a_model_that_is_never_wrong_has_nothing_to_show_on_a_logarithmic_scale(make_results):
    missions, steps = make_results(seeds=1)
    exact = missions.loc[missions["method"] == "physics", "mission"]
    steps.loc[steps["mission"].isin(exact), "error"] = 0.0
    assert pixels(draw_learning(missions, steps, "m, rad")).std() > 0


@pytest.mark.parametrize(("count", "sizes"), [(1, [1]), (6, [6]), (7, [4, 3]), (15, [5, 5, 5])])
def test_no_figure_shows_more_methods_than_there_are_colours(count, sizes):
    names = [f"m{k}" for k in range(count)]
    groups = groups_of_methods(names)
    assert [len(group) for group in groups] == sizes
    assert sum(groups, []) == names


# Trajectories


def test_one_map_per_method_and_cell(make_results, ring):
    figure = draw_trajectories(*make_results(v_gains=[-1.0, 2.0], seeds=2), LAPS, [ring])
    assert titles(figure) == ["physics", "adaptive", "oracle"] * 2
    assert "6 of 12 missions not shown" in texts(figure)
    assert any("v_gain = 2\n" in text for text in texts(figure))


def test_a_map_says_how_the_mission_fared(make_results, ring):
    shown = texts(draw_trajectories(*make_results(), LAPS, [ring]))
    for text in ("25 %, 399 steps", "100 %, 119 steps", "100 %, 99 steps"):
        assert text in shown
    assert "ring, v_gain = -1" in shown
    assert not any("not shown" in text for text in shown)


def test_the_changed_stretch_is_coloured_and_shaded(make_results, ring, artists):
    missions, steps = make_results(["oracle"])
    (axes,) = draw_trajectories(missions, steps, LAPS, [ring]).axes
    (changed,), (band,) = artists(axes, "changed"), artists(axes, "band")
    active = steps["regime_active"].to_numpy(dtype=bool)
    expected = active | np.roll(active, 1)  # a move has two ends
    for line in (changed, band):
        assert (np.isfinite(line.get_xdata()) == expected).all()
        np.testing.assert_array_equal(line.get_xdata()[expected], steps["x"][expected])
    assert to_hex(changed.get_color()) == REGIME
    assert band.get_linewidth() > 4 * changed.get_linewidth()
    (whole,) = artists(axes, "nominal")
    np.testing.assert_array_equal(whole.get_xydata(), steps[["x", "y"]])


def test_the_road_is_as_wide_as_the_track_says(make_results, ring, artists):
    (axes,) = draw_trajectories(*make_results(["oracle"]), LAPS, [ring]).axes
    (road,) = artists(axes, "road")
    np.testing.assert_allclose(road.get_widths(), ring.width)
    np.testing.assert_allclose(np.hypot(*road.get_offsets().T), 4.0, rtol=1e-3)
    (dots,) = artists(axes, "waypoints")
    assert len(dots.get_xdata()) == len(ring.waypoints)
    assert axes.get_aspect() == 1


def test_marks_say_how_it_began_and_ended(make_results, ring, artists):
    missions, steps = make_results()
    lost, _, done = draw_trajectories(missions, steps, LAPS, [ring]).axes
    for axes in (lost, done):
        (start,) = artists(axes, "start")
        np.testing.assert_allclose(start.get_xydata(), [[4.0, 0.0]], atol=1e-9)
    assert len(artists(lost, "given up")) == len(artists(done, "finished")) == 1
    assert not artists(lost, "finished") + artists(done, "given up")
    (end,) = artists(done, "finished")
    np.testing.assert_array_equal(end.get_xydata()[0], steps[["x", "y"]].iloc[-1])


def test_who_goes_astray_does_not_shrink_the_map(make_results, ring, artists):
    missions, steps = make_results()
    axes = draw_trajectories(missions, steps, LAPS, [ring]).axes[0]
    last = steps[steps["mission"] == 0][["x", "y"]].iloc[-1].to_numpy()
    left, right = axes.get_xlim()
    assert last[0] < -90
    assert right - left < 13
    (end,) = artists(axes, "given up")
    assert left < end.get_xdata()[0] < right
    assert f"ends {distance_to(ring, last):.0f} m away" in texts(axes)


def test_a_track_that_is_not_given_is_left_out(make_results, artists):
    figure = draw_trajectories(*make_results(), LAPS)
    assert not artists(figure, "road")
    assert len(artists(figure, "nominal")) == 3
    assert not any("away" in text for text in texts(figure))
    png_bytes(figure)


@pytest.mark.parametrize("given", [True, False])
def test_places_that_are_not_finite_are_passed_over(make_results, ring, artists, given):
    missions, steps = make_results(["oracle"])
    some = steps.assign(x=steps["x"].where(steps["t"] < 50))
    figure = draw_trajectories(missions, some, LAPS, [ring] * given)
    (end,) = artists(figure, "finished")
    np.testing.assert_array_equal(end.get_xydata()[0], steps[["x", "y"]].iloc[49])
    nowhere = draw_trajectories(missions, steps.assign(y=np.nan), LAPS, [ring] * given)
    assert not artists(nowhere, "start")
    png_bytes(nowhere)


# Learning


def test_whether_plans_came_true_stands_first(make_results, artists):
    missions, steps = make_results(v_gains=[-1.0, 2.0])
    figure = draw_learning(missions, steps, "m, rad")
    assert len(figure.axes) == 4 * 2
    for axes in figure.axes:
        assert len(artists(axes, "curve")) == 3
    labels = [axes.get_ylabel().replace("\n", " ") for axes in figure.axes[::2]]
    assert labels == [
        "distance from the plan (m, rad)",
        "distance from the prediction (m, rad)",
        "model's error (m, rad)",
        "model's loss (NLL)",
    ]
    assert [axes.get_yscale() for axes in figure.axes[::2]] == ["log"] * 3 + ["symlog"]
    assert {"physics", "adaptive", "oracle"} <= set(texts(figure))
    blind = draw_learning(missions, steps.assign(unforeseen=np.nan).drop(columns="miss"))
    assert len(blind.axes) == 2 * 2


def test_six_methods_and_four_cells_at_most(make_results):
    figure = draw_learning(*make_results(v_gains=range(1, 7), seeds=2))
    assert len(figure.axes) == 4 * 4
    assert "24 of 36 missions not shown" in texts(figure)
    missions, steps = make_results(["oracle"])
    many = pd.concat([missions.assign(method=f"m{k}", mission=k) for k in range(8)])
    figure = draw_learning(many, pd.concat([steps.assign(mission=k) for k in range(8)]))
    assert "2 of 8 missions not shown" in texts(figure)


def test_a_curve_is_what_was_measured(make_results, artists):
    missions, steps = make_results(["oracle"])
    miss = steps["miss"].where(steps["t"] != 30, 77.0)  # one step that a mean would hide
    axes = draw_learning(missions, steps.assign(miss=miss)).axes[0]
    (curve,) = artists(axes, "curve")
    np.testing.assert_array_equal(curve.get_ydata(), miss)


def test_each_method_shows_where_its_regime_starts_and_ends(make_results, artists):
    missions, steps = make_results(["adaptive", "oracle"])
    axes = draw_learning(missions, steps).axes[0]
    marks = [artist for artist in artists(axes, "change") if hasattr(artist, "get_marker")]
    found = [(mark.get_marker(), *mark.get_xdata()) for mark in marks]
    assert found == [(">", 25), ("<", 96), (">", 21), ("<", 80)]
    colors = [style.color for style in method_styles(missions["method"]).values()]
    assert [mark.get_color() for mark in marks] == list(np.repeat(colors, 2))
    assert not artists(axes, "band")


def test_numbers_that_cannot_be_drawn_do_no_harm(make_results):
    missions, steps = make_results(["oracle"])
    error, loss = steps["error"].copy(), steps["loss"].copy()
    error[5:8], loss[9:11] = [0.0, np.nan, np.inf], [np.inf, -np.inf]
    figure = draw_learning(missions, steps.assign(miss=error, loss=loss))
    png_bytes(figure)
    assert figure.axes[0].get_ylim()[0] > 1e-7
    with warnings.catch_warnings(action="error"):
        png_bytes(draw_learning(missions, steps.assign(miss=0.0, loss=np.nan)))


# Comparison


def test_means_and_intervals_of_each_method(make_results, artists):
    missions, _ = make_results(["physics", "oracle"], seeds=4)
    spread = missions.assign(success_rate=[0.2, 0.4, 0.2, 0.4, 1.0, 1.0, 1.0, 1.0])
    success, steps = draw_comparison(spread, LAPS).axes
    means = [mark.get_xdata()[0] for mark in artists(success, "mean")]
    np.testing.assert_allclose(means, [30.0, 100.0])
    (interval,) = artists(success, "interval")  # none where all are alike
    low, high = interval.get_xdata()
    assert 20 <= low < 30 < high <= 40
    assert list(interval.get_ydata()) == [0, 0]
    assert len(artists(steps, "interval")) == 2
    assert [len(dots.get_xdata()) for dots in artists(steps, "single")] == [4, 4]
    labels = [label.get_text() for label in success.get_yticklabels()]
    assert labels == ["physics (n = 4)", "oracle (n = 4)"]


def test_axes_say_what_is_better_and_hold_negative_values(make_results):
    missions, _ = make_results(seeds=2)
    reward = Measures((Measure("reward", "return", "return"),))
    (axes,) = draw_comparison(missions.assign(reward=-3.0 - missions["seed"]), reward).axes
    assert axes.get_xlabel() == "return\nhigher is better"
    assert axes.get_xlim()[0] < -4 and axes.get_xlim()[1] == 0
