"""The whole report: files, page, LaTeX."""

import base64
import re
from html.parser import HTMLParser

import pandas as pd
import pytest

from afm_rl.errors import ConfigurationError
from afm_rl.report import write_report, write_run
from afm_rl.report.table import Table, best_places

QUIET = {"figures": False, "tensorboard": False, "echo": lambda line: None}


@pytest.fixture
def run_folder(tmp_path, make_results):
    def write(name="run", change=lambda missions: missions, **chosen):
        missions, steps = make_results(**chosen)
        write_run(tmp_path / name, change(missions), steps, **QUIET)
        return tmp_path / name

    return write


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
    figures = ["aggregate", "profile", "progress", "error_ring", "loss_ring", "heat_ring"]
    assert files(folder) == {
        "index.html",
        "missing.csv",
        *(f"tables/{name}.{kind}" for name in tables for kind in ("csv", "tex")),
        *(f"figures/{name}.png" for name in [*figures, "feasible"]),
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
    assert "missing: physics: 1 mission in ring, v_gain = 2" in said
    assert "There are no missions of online_pe: comparisons with it are left out." in said
    expected = [["physics", "ring, v_gain = 2", 0]]
    assert pd.read_csv(folder / "missing.csv").to_numpy().tolist() == expected
    page = Page((folder / "index.html").read_text())
    assert "Missing missions" in page.texts
    assert "ring, v_gain = 2" in page.texts


def test_the_paper_s_tables_come_with_its_regimes(run_folder, report):
    folder, _ = report(run_folder(tracks=["ethz_1"], methods=["physics"]), figures=False)
    table = pd.read_csv(folder / "tables" / "paper_ethz_1_success.csv")
    mine = table[table["missions"] > 0]
    assert mine[["method", "v_gain", "omega_gain"]].to_numpy().tolist() == [["physics", -1.0, 1.0]]
    assert mine["ours_mean"].item() == 0.25 and mine["published_mean"].item() == 0.18
    assert "tables/paper_ethz_2_steps.csv" not in files(folder)


def test_results_without_steps_make_tables_and_bars(run_folder, report):
    source = run_folder(seeds=2)
    (source / "steps.parquet").unlink()
    folder, said = report(source)
    assert any("6 of 6 missions have no steps.parquet" in line for line in said)
    written = files(folder)
    assert "tables/recovery.csv" not in written
    assert {"figures/aggregate.png", "figures/profile.png", "figures/feasible.png"} <= written
    assert len([name for name in written if name.endswith(".png")]) == 3


def test_robots_of_another_kind_have_no_picture_of_theirs(run_folder, report):
    source = run_folder(change=lambda missions: missions.rename(columns={"v_gain": "mass"}))
    folder, _ = report(source)
    assert "figures/feasible.png" not in files(folder)


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
    assert best_places(values, {"a": "max", "b": "min"}, {"a": 1, "b": 2}) == {(1, 2)}


def test_signs_become_commands():
    shown = pd.DataFrame({"a_b": ["1 ± 2"], "c%": ["∞"]})
    text = Table("t", "T & U", "50 %", shown, shown, frozenset({(0, 1)})).to_latex()
    assert r"a\_b & c\% \\" in text
    assert r"1 $\pm$ 2 & \textbf{$\infty$} \\" in text
    assert r"\caption{T \& U. 50 \%}" in text
