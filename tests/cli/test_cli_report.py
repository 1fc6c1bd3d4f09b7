"""The command ``afm-rl-report``."""

import functools

import pandas as pd
import pytest
from laps import results, write_results

from afm_rl.cli import report


@pytest.fixture
def run_folder(tmp_path):
    """A run of two methods on a track of the catalogue."""
    return write_results(tmp_path, *results(("physics", "oracle"), seeds=2, tracks=("ethz_2",)))


@pytest.fixture
def call(called):
    return functools.partial(called, report.main, "afm-rl-report")


def test_a_report_of_a_run(call, run_folder):
    done = call(run_folder, "--baselines", "physics")
    assert (done.status, done.err) == (0, "")
    assert done.out.splitlines()[0].startswith("4 missions of 2 methods in 1 scenarios")
    assert done.out.splitlines()[-1] == f"Report: {run_folder}/report/index.html"
    assert (run_folder / "report" / "figures" / "trajectory_ethz_2.png").exists()


def test_what_a_run_found_of_its_actuators(call, run_folder):
    path = run_folder / "diagnosis" / "diagnosis.json"
    path.parent.mkdir()
    path.write_text('{"actuators": [{"name": "v", "sentence": "v: reversed"}]}')
    done = call(run_folder, "--no-figures")
    assert f"{run_folder}: v: reversed" in done.out.splitlines()
    assert "v: reversed</li>" in (run_folder / "report" / "index.html").read_text()
    path.write_text("[]")
    done = call(run_folder, "--no-figures")
    assert done.status == 2 and f"afm-rl-report: {path}: damaged; delete it: " in done.err


def test_films_in_place_of_a_report(call, afm_rl, tmp_path, quick):
    chosen = ["method=physics", "budget=3", f"hydra.run.dir={tmp_path}"]
    assert afm_rl(*chosen, *quick, "video=true").status == 0
    done = call(tmp_path, "--video", "gif")
    film = tmp_path / "report" / "video" / "physics.gif"
    assert (done.status, done.err, done.out) == (0, "", f"wrote {film}\n")
    assert film.read_bytes() == (tmp_path / "video" / "physics.gif").read_bytes()
    assert not (tmp_path / "report" / "index.html").exists()


def test_tables_only_in_a_folder_of_one_s_choice(call, run_folder, tmp_path):
    done = call(run_folder, "--out", tmp_path / "elsewhere", "--no-figures", "--oracle", "physics")
    assert done.status == 0
    assert not (tmp_path / "elsewhere" / "figures").exists()
    tables = tmp_path / "elsewhere" / "tables"
    assert pd.read_csv(tables / "aggregate.csv")["missions"].tolist() == [2, 2]
    assert "physics apart" in (tmp_path / "elsewhere" / "index.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: FOLDER"),
        (["nowhere"], "nowhere: no such folder"),
        (["nowhere", "--video", "avi"], "argument --video: invalid choice: 'avi'"),
    ],
)
def test_mistakes_end_in_one_line(call, arguments, message):
    done = call(*arguments)
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith(f"afm-rl-report: {message}") and done.err.count("\n") == 1
