"""Tables, texts and figures of made-up results are those that were looked at and stored."""

import io
import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Text
from test_films import fly

from afm_rl.report import (
    draw_comparison,
    draw_learning,
    draw_trajectories,
    print_summary,
    read_runs,
    write_report,
)
from afm_rl.report.comparison import draw_progress
from afm_rl.report.figures import read_excerpts
from afm_rl.report.scenes import map_scene, space_scene
from afm_rl.report.style import method_styles
from afm_rl.storage.measures import Measure, Measures


def places(points):
    """Return how many points there are, how many can be drawn, their ends and their mean."""
    points = np.asarray(points, dtype=float)
    seen = points[np.isfinite(points).all(-1)]
    ends = [seen[0], seen[-1], seen.mean(0)] if len(seen) else []
    return [len(points), len(seen), *(np.round(end, 6).tolist() for end in ends)]


def shown(artist):
    """Return what an artist shows, in few numbers, whatever its colours and widths."""
    if isinstance(artist, Text):
        return artist.get_text()
    if isinstance(artist, Line2D):
        data = artist.get_data_3d() if hasattr(artist, "get_data_3d") else artist.get_data()
        return [*places(np.stack([np.ravel(x) for x in data], -1)), artist.get_marker()]
    if isinstance(artist, Polygon):
        return places(artist.get_xy())
    if hasattr(artist, "get_widths"):  # the road
        return places(artist.get_offsets())
    return type(artist).__name__


def figure(drawn):
    """Return what a figure shows: texts, axes, and the artists that carry a name."""
    return {
        "texts": [text.get_text() for text in drawn.findobj(Text) if text.get_text()],
        "axes": [
            [axes.get_xscale(), *axes.get_xlim(), axes.get_yscale(), *axes.get_ylim()]
            for axes in drawn.axes
        ],
        "artists": [[one.get_gid(), shown(one)] for one in drawn.findobj() if one.get_gid()],
    }


def moving(scene, step):
    """Return what moves in a film, at a step."""
    scene.show(step)
    return [[type(artist).__name__, shown(artist)] for artist in scene.moving]


RETURN = Measures((Measure("reward", "return", "return"),))
SUCCESS = 4 * [0.2, 0.4] + 4 * [1.0]
DRAWN = {
    "maps of two scenarios": lambda results, ring, laps: draw_trajectories(
        *results(v_gains=[-1.0, 2.0], seeds=2), laps, [ring]
    ),
    "maps without their track": lambda results, ring, laps: draw_trajectories(*results(), laps),
    "learning": lambda results, ring, laps: draw_learning(*results(v_gains=[-1, 2]), "m, rad"),
    "learning without misses": lambda results, ring, laps: draw_learning(
        results()[0], results()[1].assign(unforeseen=np.nan).drop(columns="miss")
    ),
    "means": lambda results, ring, laps: draw_comparison(
        results(seeds=4)[0].assign(success_rate=SUCCESS), laps
    ),
    "negative means": lambda results, ring, laps: draw_comparison(
        results()[0].assign(reward=[-3.0, -4.0, -5.0]), RETURN
    ),
}
SCENES = {
    "a drive": lambda steps, ring: moving(
        map_scene("title", {"oracle": steps["oracle"]}, ring), 50
    ),
    "three drives": lambda steps, ring: moving(map_scene("title", steps, ring), 150),
    "a drive without headings": lambda steps, ring: moving(
        map_scene("title", {"oracle": steps["oracle"].drop(columns="theta")}), 3
    ),
    "a flight": lambda steps, ring: moving(space_scene("title", fly()[1]), 12),
}


@pytest.mark.parametrize("name", DRAWN)
def test_figures(golden, make_results, ring, laps, name):
    golden(figure(DRAWN[name](make_results, ring, laps)))


def test_the_figure_of_progress(golden, run_folder):
    runs = read_runs([run_folder(seeds=2)])
    _, progress = read_excerpts(runs)
    golden(figure(draw_progress(progress, method_styles(runs.methods), "targets")))


@pytest.mark.parametrize("name", SCENES)
def test_scenes_of_films(golden, make_results, ring, name):
    missions, steps = make_results()
    each = {method: steps[steps["mission"] == k] for k, method in enumerate(missions["method"])}
    each = {method: rows.reset_index(drop=True) for method, rows in each.items()}
    golden(SCENES[name](each, ring))


def test_the_tables_of_a_report(golden, run_folder, ring, tmp_path):
    folders = [
        run_folder("a", methods=["physics", "oracle"], seeds=2),
        run_folder("b", methods=["adaptive", "oracle"], v_gains=[2.0]),
    ]
    said, out = [], tmp_path / "out"
    settings = {"baselines": ["physics", "online_pe"], "figures": False, "echo": said.append}
    write_report(read_runs(folders), out, [ring], **settings)
    tables = {path.name: pd.read_csv(path).to_dict("list") for path in sorted(out.rglob("*.csv"))}
    latex = {path.name: path.read_text().splitlines() for path in sorted(out.rglob("*.tex"))}
    page = re.sub("<style.*?</style>|<[^>]*>", "\n", (out / "index.html").read_text(), flags=re.S)
    said = [line.replace(str(tmp_path), "") for line in said]
    page = re.split(r"\s*\n\s*", page.replace(str(tmp_path), ""))
    golden({"said": said, "page": page, **tables, **latex})


@pytest.mark.parametrize("scenarios", [1, 2])
def test_the_table_in_the_terminal(golden, make_results, laps, scenarios):
    file = io.StringIO()
    print_summary(make_results(seeds=2, v_gains=[-1.0, 2.0][:scenarios])[0], laps, file)
    golden(file.getvalue().splitlines())
