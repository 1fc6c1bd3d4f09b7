"""The whole report: files, page, LaTeX."""

import base64
import re
from html.parser import HTMLParser

import pandas as pd
import pytest

from afm_rl.errors import ConfigurationError
from afm_rl.report import write_report, write_run
from afm_rl.report.table import Table, best_places
from afm_rl.storage.manifest import write_manifest
from afm_rl.storage.measures import Measure, Measures


@pytest.fixture
def report(tmp_path, ring):
    """Write a report; return its folder and what was said."""

    def write(*folders, **settings):
        said = []

        def load(name):
            if name != "ring":
                raise ConfigurationError(f"{name}: no such track")
            return ring

        settings = {"load_track": load, "baselines": ["physics"]} | settings
        page = write_report(folders, tmp_path / "out", echo=said.append, **settings)
        assert page == tmp_path / "out" / "index.html"
        return tmp_path / "out", said

    return write


def files(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


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


def test_everything_is_written(run_folder, report):
    folder, said = report(run_folder(seeds=2, v_gains=[-1.0, 2.0]))
    tables = ["aggregate", "against_physics", "recovery", "cells"]
    figures = ["summary", "learning_ring", "profile", "progress", "heat_ring"]
    assert files(folder) == {
        "index.html",
        "missing.csv",
        *(f"tables/{name}.{kind}" for name in tables for kind in ("csv", "tex")),
        *(f"figures/{name}.png" for name in figures),
    }
    assert said[0].startswith("12 missions of 3 methods in 2 cells")
    assert said[-1] == f"Report: {folder / 'index.html'}"
    assert pd.read_csv(folder / "missing.csv").empty


def test_the_page_needs_nothing_else(run_folder, report):
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


def test_the_contents_lead_somewhere(run_folder, report):
    folder, _ = report(run_folder(seeds=2))
    found = Page((folder / "index.html").read_text()).found
    names = [attrs["id"] for _, attrs in found if "id" in attrs]
    links = [attrs["href"].removeprefix("#") for tag, attrs in found if tag == "a"]
    assert links == names and len(set(names)) == len(names) > 8


def test_names_are_no_markup(run_folder, report):
    strange = r"<b>\a_%&#${}~^</b>"
    source = run_folder(change=lambda missions: missions.replace("physics", strange), seeds=2)
    folder, _ = report(source, baselines=[strange], figures=False)
    page = Page((folder / "index.html").read_text())
    assert "b" not in {tag for tag, _ in page.found}
    assert strange in page.texts
    for path in (folder / "tables").glob("*.tex"):
        check_latex(path.read_text())


def test_names_stay_inside_the_folder(run_folder, report, tmp_path):
    source = run_folder(change=lambda missions: missions.replace("physics", "../../up"))
    before = {path for path in tmp_path.iterdir()}
    folder, _ = report(source, baselines=["../../up"], figures=False)
    assert set(tmp_path.iterdir()) == {*before, folder}
    assert "tables/against_.._.._up.csv" in files(folder)


def check_latex(text):
    """Are braces and environments balanced, special signs escaped, rows equally long?"""
    plain = re.sub(r"\\[\\%_#&${}]", "", text.replace(r"\\", "\n"))
    assert plain.count("{") == plain.count("}")
    assert re.findall(r"\\begin{(\w+)}", text) == re.findall(r"\\end{(\w+)}", text)[::-1]
    body = plain.split("\\toprule")[1].split("\\bottomrule")[0]
    columns = len(re.search(r"\\begin{tabular}{([lr]*)", text)[1]) + ("p{" in text)
    rows = [line for line in body.splitlines() if "&" in line]
    assert rows and all(line.count("&") == columns - 1 for line in rows)
    label = re.search(r"\\label{.*}\n", text)[0]
    prose = re.sub(r"\$\\(pm|infty)\$", "", plain.replace(label, ""))
    assert not re.search(r"[_#$^~±∞]", re.sub(r"\\text\w+{}", "", prose))


def test_tables_can_be_set_in_latex(run_folder, report):
    folder, _ = report(
        run_folder(seeds=2, v_gains=[-1.0, 2.0]),
        run_folder("more", methods=["oracle"], v_gains=[3.0]),
        figures=False,
    )
    names = sorted((folder / "tables").glob("*.tex"))
    assert len(names) == 5
    for path in names:
        check_latex(path.read_text())
    text = (folder / "tables" / "cells.tex").read_text()
    assert r"v\_gain = -1" in text and r"\textbf{" in text


def test_what_is_missing_is_said_three_times(run_folder, report):
    folder, said = report(
        run_folder("a", methods=["physics", "oracle"], seeds=2),
        run_folder("b", methods=["oracle"], v_gains=[2.0]),
        baselines=["physics", "online_pe"],
    )
    assert "missing: physics: 1 missions, seeds 0, cells ring, v_gain = 2" in said
    assert "There are no missions of online_pe: comparisons with it are left out." in said
    expected = [["physics", "ring, v_gain = 2", 0]]
    assert pd.read_csv(folder / "missing.csv").to_numpy().tolist() == expected
    page = Page((folder / "index.html").read_text())
    assert "Missing missions" in page.texts
    assert "ring, v_gain = 2" in page.texts


def test_results_without_steps_make_tables_and_bars(run_folder, report):
    source = run_folder(seeds=2)
    (source / "steps.parquet").unlink()
    write_manifest(source)
    folder, said = report(source)
    assert any("6 of 6 missions have no steps.parquet" in line for line in said)
    written = files(folder)
    assert "tables/recovery.csv" not in written
    pictures = {name for name in written if name.endswith(".png")}
    assert pictures == {"figures/summary.png", "figures/profile.png"}


@pytest.fixture
def rewards():
    """Measures of a third kind of robot, which has no positions either."""
    return Measures(
        (
            Measure("return", "return", "return", digits=1, headline=True),
            Measure("after", "after", "reward per step after the change", digits=3),
            Measure("recovery_steps", "recovery", "steps to recover", better="lower"),
        )
    )


def test_a_third_kind_of_robot_needs_no_change(tmp_path, make_results, rewards, report):
    missions, steps = make_results(seeds=2)
    new = {"return": -10.0 * missions["steps"], "after": 0.5, "recovery_steps": [3, 4, 5, 9, 9, 9]}
    missions = missions.drop(columns=["success_rate", "reached", "targets"]).assign(**new)
    steps = steps.drop(columns=["x", "y", "theta", "goal_x", "goal_y", "reached"])
    write_run(tmp_path / "run", missions, steps, rewards, echo=lambda line: None)
    write_manifest(tmp_path / "run")
    drawn = {path.name for path in (tmp_path / "run" / "figures").iterdir()}
    assert drawn == {"learning.png", "summary.png"}
    folder, _ = report(tmp_path / "run")
    assert {name for name in files(folder) if name.endswith(".png")} == {
        "figures/summary.png",
        "figures/learning_ring.png",
    }
    means = pd.read_csv(folder / "tables" / "aggregate.csv").set_index("method")
    assert means.loc["oracle", "return"] == -995.0 and means.loc["physics", "recovery_steps"] == 3.5
    page = Page((folder / "index.html").read_text())
    assert "return" in page.texts and not {"steps", "success (%)"} & set(page.texts)


def test_kinds_of_missions_do_not_mix(run_folder, make_results, report, rewards, tmp_path):
    missions, steps = make_results(["oracle"])
    missions = missions.assign(**{"return": 1.0, "after": 1.0, "recovery_steps": 1})
    write_run(tmp_path / "other", missions, steps, rewards, echo=lambda line: None, figures=False)
    write_manifest(tmp_path / "other")
    with pytest.raises(ConfigurationError, match="hold missions of different kinds"):
        report(run_folder(), tmp_path / "other")


def test_figures_come_first(run_folder, report):
    folder, _ = report(run_folder(seeds=2))
    found = Page((folder / "index.html").read_text()).found
    names = [attrs["id"] for _, attrs in found if "id" in attrs]
    assert [name.split("-")[0] for name in names] == ["figure"] * 5 + ["table"] * 4


def test_budgets_are_said(run_folder, report):
    folder, said = report(run_folder(), figures=False)
    (line,) = (line for line in said if "did not finish" in line)
    assert line.startswith("1 of 3 missions did not finish within their budget and count as 399")
    assert line in Page((folder / "index.html").read_text()).texts


def test_many_methods_fill_several_figures(run_folder, make_results, report):
    def many(missions):
        return missions.assign(method=[f"m{k}" for k in range(len(missions))])

    folder, _ = report(run_folder(change=many, methods=["oracle"] * 7))
    names = {name for name in files(folder) if name.endswith(".png")}
    for name in ("learning_ring", "profile", "progress", "heat_ring"):
        assert {f"figures/{name}_1.png", f"figures/{name}_2.png"} <= names


def test_names_that_are_formulas_stay_texts(run_folder, report):
    strange = "=cmd|' /C calc'!A0"
    source = run_folder(change=lambda missions: missions.replace("physics", strange), seeds=2)
    folder, _ = report(source, baselines=[strange], figures=False)
    for path in folder.rglob("*.csv"):
        for line in path.read_text().splitlines():
            assert not line.startswith(("=", '"=')) and ",=" not in line and ',"=' not in line
    assert strange in Page((folder / "index.html").read_text()).texts


@pytest.mark.parametrize("load", [None, "own"])
def test_tracks_that_cannot_be_loaded_have_no_road(run_folder, report, load):
    settings = {} if load else {"load_track": None}
    folder, _ = report(run_folder(tracks=["elsewhere"]), **settings)
    assert "figures/heat_elsewhere.png" in files(folder)


def test_writing_again_replaces(run_folder, report):
    source = run_folder(seeds=2)
    folder, _ = report(source)
    before = {name: (folder / name).read_bytes() for name in files(folder)}
    report(source)
    assert {name: (folder / name).read_bytes() for name in files(folder)} == before


def test_a_folder_that_cannot_be_written(run_folder, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="cannot write"):
        write_report([run_folder()], tmp_path / "file" / "report", echo=lambda line: None)


def test_the_best_is_not_marked_where_all_are_alike():
    values = pd.DataFrame({"a": [1.0, 1.0], "b": [2.0, 1.0]}, index=[7, 7])
    assert best_places(values, {"a": 1, "b": -1}) == {(1, 3)}


def test_signs_become_commands():
    shown = pd.DataFrame({"a_b": ["1 ± 2"], "c%": ["∞"]})
    text = Table("t", "T & U", "50 %", shown, shown, frozenset({(0, 1)})).to_latex()
    assert r"a\_b & c\% \\" in text
    assert r"1 $\pm$ 2 & \textbf{$\infty$} \\" in text
    assert r"\caption{T \& U. 50 \%}" in text
