"""What the figures show."""

import io
import warnings

import numpy as np
import pandas as pd
import pytest
from laps import LAPS
from matplotlib import _pylab_helpers
from matplotlib.image import imread
from matplotlib.text import Text

from afm_rl.report import draw_comparison, draw_learning, draw_trajectories
from afm_rl.report.style import DPI, png_bytes


def texts(figure):
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def pixels(figure):
    return imread(io.BytesIO(png_bytes(figure)))


ALL = {
    "trajectory": lambda missions, steps, ring: draw_trajectories(missions, steps, LAPS, [ring]),
    "learning": lambda missions, steps, ring: draw_learning(missions, steps, "m, rad"),
    "comparison": lambda missions, steps, ring: draw_comparison(missions, LAPS),
}


@pytest.fixture(params=ALL)
def draw(request, ring):
    return lambda missions, steps: ALL[request.param](missions, steps, ring)


@pytest.mark.slow
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


def test_six_methods_and_four_cells_at_most(make_results):
    figure = draw_learning(*make_results(v_gains=range(1, 7), seeds=2))
    assert len(figure.axes) == 4 * 4
    assert "24 of 36 missions not shown" in texts(figure)
    missions, steps = make_results(["oracle"])
    many = pd.concat([missions.assign(method=f"m{k}", mission=k) for k in range(8)])
    figure = draw_learning(many, pd.concat([steps.assign(mission=k) for k in range(8)]))
    assert "2 of 8 missions not shown" in texts(figure)


def test_numbers_that_cannot_be_drawn_do_no_harm(make_results):
    missions, steps = make_results(["oracle"])
    error, loss = steps["error"].copy(), steps["loss"].copy()
    error[5:8], loss[9:11] = [0.0, np.nan, np.inf], [np.inf, -np.inf]
    figure = draw_learning(missions, steps.assign(miss=error, loss=loss))
    png_bytes(figure)
    assert figure.axes[0].get_ylim()[0] > 1e-7
    with warnings.catch_warnings(action="error"):
        png_bytes(draw_learning(missions, steps.assign(miss=0.0, error=0.0, loss=np.nan)))
