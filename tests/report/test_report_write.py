"""The whole report: files and page."""

import base64
import os
import re
from html.parser import HTMLParser

import pandas as pd
import pytest
from harness import files_of

from afm_rl.errors import ConfigurationError
from afm_rl.report import read_runs, write_report, write_run
from afm_rl.storage.files import file_name
from afm_rl.storage.manifest import write_manifest
from afm_rl.storage.measures import Measure, Measures


@pytest.fixture
def report(tmp_path, ring):
    """Write a report; return its folder and what was said."""

    def write(*folders, **settings):
        said = []
        settings = {"baselines": ["physics"]} | settings
        runs, out = read_runs(folders), tmp_path / "out"
        page = write_report(runs, out, [ring], echo=said.append, **settings)
        assert page == tmp_path / "out" / "index.html"
        return tmp_path / "out", said

    return write


class Page(HTMLParser):
    """Reads which elements a page has, and that they are closed in order."""

    OPEN_ENDED = {"meta", "img"}

    def __init__(self, text):
        super().__init__()
        self.stack, self.found, self.texts = [], [], []
        self.feed(text)
        assert not self.stack

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in self.OPEN_ENDED:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


@pytest.mark.slow
def test_everything_is_written_the_same_each_time(run_folder, report):
    source = run_folder(seeds=2, v_gains=[-1.0, 2.0])
    folder, said = report(source)
    tables = ["aggregate", "against_physics", "recovery", "scenarios"]
    figures = ["summary", "learning_ring", "progress", "trajectory_ring"]
    assert files_of(folder).keys() == {
        "index.html",
        "missing.csv",
        *(f"tables/{name}.csv" for name in tables),
        *(f"figures/{name}.png" for name in figures),
    }
    assert said[0].startswith("12 missions of 3 methods in 2 scenarios")
    assert said[-1] == f"Report: {folder / 'index.html'}"
    assert pd.read_csv(folder / "missing.csv").empty
    before = files_of(folder)
    report(source)
    assert files_of(folder) == before


def test_the_page_needs_nothing_else_and_its_contents_lead_somewhere(run_folder, report):
    folder, _ = report(run_folder(seeds=2))
    text = (folder / "index.html").read_text(encoding="utf-8")
    page = Page(text)
    assert "http" not in re.sub('base64,[^"]*', "", text)
    assert not {"link", "script", "iframe"} & {tag for tag, _ in page.found}
    sources = [attrs["src"] for tag, attrs in page.found if tag == "img"]
    pictures = {path.read_bytes() for path in (folder / "figures").iterdir()}
    prefix = "data:image/png;base64,"
    assert all(source.startswith(prefix) for source in sources)
    assert {base64.b64decode(source.removeprefix(prefix)) for source in sources} == pictures
    assert sum(tag == "figcaption" for tag, _ in page.found) == len(sources)
    names = [attrs["id"] for _, attrs in page.found if "id" in attrs]
    links = [attrs["href"].removeprefix("#") for tag, attrs in page.found if tag == "a"]
    assert links == names and len(set(names)) == len(names)
    assert [name.split("-")[0] for name in names] == ["figure"] * 4 + ["table"] * 4


@pytest.mark.parametrize("strange", [r"<b>\a_%&#${}~^</b>", "../../up", "=cmd|' /C calc'!A0"])
def test_names_are_no_markup_no_folders_and_no_formulas(strange, run_folder, report, tmp_path):
    source = run_folder(change=lambda missions: missions.replace("physics", strange), seeds=2)
    before = {*tmp_path.iterdir()}
    folder, _ = report(source, baselines=[strange], figures=False)
    assert {*tmp_path.iterdir()} == {*before, folder}
    assert f"tables/{file_name(f'against_{strange}')}.csv" in files_of(folder).keys()
    page = Page((folder / "index.html").read_text())
    assert "b" not in {tag for tag, _ in page.found} and strange in page.texts
    for path in folder.rglob("*.csv"):
        for line in path.read_text().splitlines():
            assert not line.startswith(("=", '"=')) and ",=" not in line and ',"=' not in line


def test_results_without_steps_make_tables_and_bars(run_folder, report):
    source = run_folder(seeds=2)
    (source / "steps.parquet").unlink()
    write_manifest(source)
    folder, said = report(source)
    assert any("6 of 6 missions have no steps.parquet" in line for line in said)
    written = files_of(folder).keys()
    assert "tables/recovery.csv" not in written
    pictures = {name for name in written if name.endswith(".png")}
    assert pictures == {"figures/summary.png"}


@pytest.fixture
def rewards():
    """Measures of a third kind of robot, which has no positions either."""
    first = Measure("return", "return", "return", digits=1, headline=True)
    second = Measure("after", "after", "reward per step after the change", digits=3)
    third = Measure("recovery_steps", "recovery", "steps to recover", better="lower")
    return Measures((first, second, third))


def test_a_third_kind_of_robot_needs_no_change(store, make_results, rewards, report):
    missions, steps = make_results(seeds=2)
    new = {"return": -10.0 * missions["steps"], "after": 0.5, "recovery_steps": [3, 4, 5, 9, 9, 9]}
    missions = missions.drop(columns=["success_rate", "reached", "targets"]).assign(**new)
    steps = steps.drop(columns=["x", "y", "theta", "goal_x", "goal_y", "reached"])
    folder, _ = report(store("run", missions, steps, rewards))
    pictures = {name for name in files_of(folder).keys() if name.endswith(".png")}
    assert pictures == {"figures/summary.png", "figures/learning_ring.png"}
    means = pd.read_csv(folder / "tables" / "aggregate.csv").set_index("method")
    assert means.loc["oracle", "return"] == -995.0 and means.loc["physics", "recovery_steps"] == 3.5
    page = Page((folder / "index.html").read_text())
    assert "return" in page.texts and not {"steps", "success (%)"} & set(page.texts)


def test_kinds_of_missions_do_not_mix(run_folder, make_results, report, rewards, store):
    missions, steps = make_results(["oracle"])
    missions = missions.assign(**{"return": 1.0, "after": 1.0, "recovery_steps": 1})
    with pytest.raises(ConfigurationError, match="hold missions of different kinds"):
        report(run_folder(), store("other", missions, steps, rewards))


@pytest.mark.slow
def test_many_methods_fill_several_figures(run_folder, make_results, report):
    def many(missions):
        return missions.assign(method=[f"m{k}" for k in range(len(missions))])

    folder, _ = report(run_folder(change=many, methods=["oracle"] * 7))
    names = {name for name in files_of(folder).keys() if name.endswith(".png")}
    for name in ("learning_ring", "progress", "trajectory_ring"):
        assert {f"figures/{name}_1.png", f"figures/{name}_2.png"} <= names


def test_the_figures_of_a_run(tmp_path, make_results, laps, ring):
    said = []
    written = write_run(str(tmp_path), *make_results(seeds=2), laps, [ring], echo=said.append)
    names = {path.relative_to(tmp_path).as_posix() for path in written}
    assert len(said) == 3
    figures = {f"figures/{name}.png" for name in ("trajectory", "learning", "summary")}
    assert names == files_of(tmp_path).keys() == figures
    before = {name: (tmp_path / name).read_bytes() for name in names}

    def full(*_):
        raise OSError(28, "No space left on device")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(ConfigurationError, match="No space"):
        patch.setattr(os, "fsync", full)
        write_run(tmp_path, *make_results(v_gains=[0.5]), laps, [ring], echo=said.append)
    assert files_of(tmp_path) == before
