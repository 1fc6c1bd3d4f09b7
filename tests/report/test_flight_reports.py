"""Reports on flights: tables, figures and files."""

import io
from itertools import product

import numpy as np
import pandas as pd
import pytest

from afm_rl.errors import ConfigurationError
from afm_rl.report import (
    draw_comparison,
    draw_flight,
    draw_learning,
    print_summary,
    summarise,
    write_report,
    write_run,
)
from afm_rl.report.flight_report import flight_tables

TICKS = 40
SIZES = {"physics": 0.3, "oracle": 0.01}  # errors of the height (m)


def flight(number, size, seed):
    t = np.arange(TICKS)
    phase = (t >= 10).astype("int32") + (t >= 25)
    height = size * (1 + 0.1 * seed) * (phase > 0)
    columns = {
        "mission": np.full(TICKS, number, dtype="int32"),
        "t": t.astype("int32"),
        "x": 2 * np.cos(0.05 * t),
        "y": 2 * np.sin(0.05 * t),
        "z": height,
        "goal_x": 2 * np.cos(0.05 * t),
        "goal_y": 2 * np.sin(0.05 * t),
        "goal_z": np.zeros(TICKS),
        "planned_thrust": np.full(TICKS, 0.3),
        "executed_thrust": np.full(TICKS, 0.2),
        "error": np.full(TICKS, 1e-3),
        "misaligned": np.zeros(TICKS, dtype="int32"),
        "loss": np.full(TICKS, -1.0),
        "regime_active": (phase > 0).astype("int32"),
        "square_error_x": np.zeros(TICKS),
        "square_error_y": np.zeros(TICKS),
        "square_error_z": height**2,
        "phase": phase.astype("int32"),
    }
    return pd.DataFrame(columns)


def flights(methods=tuple(SIZES), tracks=("circle",), seeds=1):
    missions, steps = [], []
    for number, (method, track, seed) in enumerate(product(methods, tracks, range(seeds))):
        rows = flight(number, SIZES[method], seed)
        mse = float(rows["square_error_z"].mean())
        steps.append(rows)
        missions.append(
            {
                "mission": number,
                "method": method,
                "track": track,
                "mass": 0.5,
                "seed": seed,
                "mse": mse / 3,
                "mse_z": mse,
                "mse_phase_0": 0.0,
                "peak_z": rows["z"].max(),
                "settle_1": np.nan,
                "steps": TICKS - 1,
                "finished": True,
                "seconds": 0.5,
                "regime": "nominal; mass = 0.5",
            }
        )
    return pd.DataFrame(missions), pd.concat(steps, ignore_index=True)


def printed(missions):
    file = io.StringIO()
    print_summary(missions, file)
    return file.getvalue()


def test_the_summary_is_about_errors():
    missions, _ = flights(tracks=["circle", "eight"], seeds=2)
    means = summarise(missions)
    assert list(means)[:6] == ["method", "missions", "mse", "mse_low", "mse_high", "finished"]
    np.testing.assert_allclose(means["mse"], missions.groupby("method", sort=False)["mse"].mean())
    text = printed(missions)
    assert "MSE (m²)" in text and "MSE (m²), means" in text and "steps" not in text
    (line,) = (line for line in text.splitlines() if line.startswith(" eight"))
    assert line.split()[-2:] == ["0.02486", "0.00003"]


def test_all_files_of_a_run(tmp_path):
    missions, steps = flights(tracks=["circle", "eight"])
    write_run(tmp_path, missions, steps, echo=lambda line: None)
    figures = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert figures == ["flight.png", "learning.png", "summary.png"]
    stored = pd.read_csv(tmp_path / "missions.csv")
    assert list(stored)[:7] == ["method", "track", "mass", "seed", "mse", "mse_z", "peak_z"]
    pd.testing.assert_frame_equal(stored[missions.columns], missions)
    with pytest.raises(ConfigurationError, match="steps: columns phase are missing"):
        write_run(tmp_path, missions, steps.drop(columns="phase"))


def test_a_flight_is_drawn_in_space_and_over_time(artists):
    missions, steps = flights(tracks=["a", "b", "c", "d"], seeds=2)
    figure = draw_flight(missions, steps)
    assert len(figure.axes) == 3 * 4  # three cells are shown
    assert "10 of 16 missions not shown" in figure._supxlabel.get_text()
    space, height, thrust, distance = figure.axes[:4]
    assert len(artists(space, "path")) == len(artists(space, "reference")) == 2
    x, _, z = artists(space, "change")[0].get_data_3d()
    assert len(x) == 2 and np.allclose(z, 0.3)
    np.testing.assert_allclose(np.diff(space.get_zlim()), 1.0, rtol=0.1)  # level flights are level
    np.testing.assert_allclose(artists(height, "height")[0].get_ydata().max(), 0.3)
    assert artists(thrust, "planned")[0].get_ydata()[0] == 0.3
    assert artists(thrust, "executed")[0].get_ydata()[0] == 0.2
    np.testing.assert_allclose(artists(distance, "distance")[0].get_ydata().max(), 0.3)
    assert [line.get_xdata()[0] for line in artists(height, "change")] == [10, 25]
    assert height.get_title(loc="left") == "a, nominal; mass = 0.5"


def test_other_figures_have_the_units_of_flights():
    missions, steps = flights(seeds=2)
    label = draw_learning(missions, steps).axes[0].get_ylabel()
    assert label == "prediction error\nper step (m, m/s, rad, rad/s)"
    panels = draw_comparison(missions).axes
    assert [axes.get_xlabel() for axes in panels] == [
        "mean squared error (m²)",
        "the same along z (m²)",
    ]
    assert panels[0].get_xlim()[1] == pytest.approx(1.04 * missions["mse"].max())


def folder(path, **given):
    missions, steps = flights(**given)
    write_run(path, missions, steps, figures=False, tensorboard=False, echo=lambda line: None)
    return path


def test_a_report_on_flights(tmp_path):
    source = folder(tmp_path / "run", tracks=["circle", "eight"], seeds=2)
    lines = []
    page = write_report([source], tmp_path / "out", echo=lines.append)
    assert "8 missions of 2 methods in 2 cells" in lines[0]
    names = sorted(path.stem for path in (tmp_path / "out").glob("figures/*"))
    assert names == ["flight", "summary"]
    means = pd.read_csv(tmp_path / "out" / "tables" / "aggregate.csv").set_index("method")
    assert means.loc["oracle", "mse"] < means.loc["physics", "mse"]
    assert "All flights of each method" in page.read_text()


def test_the_best_is_bold():
    missions, _ = flights(tracks=["circle", "eight"])
    alone = missions[(missions["method"] == "oracle") | (missions["track"] == "circle")]
    methods, cells = flight_tables(alone.drop(columns="seconds"))  # a study's table has none
    assert methods.bold == {(1, 3), (1, 4)}
    assert cells.bold == {(0, 2)}
    assert cells.shown["physics"].tolist() == ["0.02250", "-"]


def test_a_report_without_steps_has_no_flights(tmp_path):
    source = folder(tmp_path / "run")
    (source / "steps.parquet").unlink()
    write_report([source], tmp_path / "out", echo=lambda line: None)
    assert [path.stem for path in (tmp_path / "out").glob("figures/*")] == ["summary"]


def test_flights_and_laps_do_not_mix(tmp_path, make_results):
    laps = tmp_path / "laps"
    write_run(laps, *make_results(), figures=False, tensorboard=False, echo=lambda line: None)
    with pytest.raises(ConfigurationError, match="hold flights and other missions"):
        write_report([folder(tmp_path / "run"), laps], tmp_path / "out")
