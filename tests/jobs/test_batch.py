"""Batches: killed at any moment, run again, extended, and with jobs that fail."""

import multiprocessing
import os
import random
import shutil
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import coverage
import pandas as pd
import pytest
import yaml
from harness import files_of

from afm_rl.errors import ConfigurationError
from afm_rl.jobs import executor, process
from afm_rl.jobs.batch import run_batch
from afm_rl.jobs.executor import Board, Executor
from afm_rl.jobs.layout import job_folders
from afm_rl.jobs.process import Job
from afm_rl.report import read_runs
from afm_rl.storage.files import file_name, locked
from afm_rl.storage.manifest import check_manifest

QUIET = {"echo": lambda line: None}


def results_of(folder):
    """Return the files of a batch and its jobs that do not depend on the clock."""
    same = ("missions.csv", "steps.parquet")
    return {name: data for name, data in files_of(folder).items() if name.endswith(same)}


@pytest.fixture
def forked(monkeypatch):
    """Fork jobs from this process, which saves them the imports."""
    monkeypatch.setattr(process, "START", "fork")


@pytest.fixture
def jobs(configure):
    """Make the configurations of jobs: each method with each seed."""

    def make(*methods, seeds=(0, 1), **settings):
        return {
            f"{method}+seed={seed}": configure(method, seeds=[seed], **settings)
            for seed in seeds
            for method in methods
        }

    return make


def test_what_a_batch_leaves_behind(jobs, tmp_path, forked, here):
    said, four = [], jobs("oracle", "physics")
    assert run_batch(tmp_path, four, Executor(2), command="afm-rl x", echo=said.append) == {}
    assert sorted(said) == sorted(f"[{k}/4] {said[k - 1].split()[1]} done" for k in range(1, 5))
    record = yaml.safe_load((tmp_path / "jobs.yaml").read_text())
    assert record == {"command": "afm-rl x", "jobs": [*four]}
    assert check_manifest(tmp_path).keys() == {"jobs.yaml", "missions.csv", "compute.csv"}
    for run in job_folders(tmp_path):
        assert "missions.csv" in check_manifest(run) and not (run / "unfinished").exists()
    missions = pd.read_csv(tmp_path / "missions.csv")
    assert missions["mission"].tolist() == [0, 1, 2, 3]
    assert missions["method"].tolist() == ["oracle"] * 2 + ["physics"] * 2
    assert missions["seed"].tolist() == [0, 1] * 2 and "seconds" not in missions
    compute = pd.read_csv(tmp_path / "compute.csv")
    assert compute["missions"].tolist() == [2, 2] and compute["steps"].tolist() == [24, 24]
    runs = read_runs([tmp_path])
    assert runs.steps().groupby("mission").size().tolist() == [12] * 4
    assert runs.missions["seconds"].gt(0).all() and runs.missions["method"].equals(
        missions["method"]
    )
    again = []
    run_batch(tmp_path, four, here, echo=again.append)
    assert again == ["4 of 4 jobs have results already"]


def test_more_jobs_extend_a_batch(jobs, tmp_path, here):
    one, other = tmp_path / "one", tmp_path / "other"
    both = jobs("oracle", "physics", seeds=[0])
    run_batch(one, jobs("oracle", seeds=[0]), here, **QUIET)
    run_batch(one, both, here, **QUIET)
    run_batch(other, both, here, **QUIET)
    assert results_of(one) == results_of(other)
    run_batch(one, jobs("physics", seeds=[0]), here, **QUIET)  # the other stays, after this one
    assert len(pd.read_csv(one / "missions.csv")) == 2


def test_nothing_is_changed_if_one_job_has_other_settings(jobs, tmp_path, here):
    run_batch(tmp_path, jobs("physics", seeds=[0]), here, **QUIET)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(ConfigurationError, match=r"budget: 12 -> 13"):
        run_batch(tmp_path, jobs("oracle", "physics", budget=13), here, **QUIET)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_folders_that_are_taken(jobs, tmp_path, here):
    with (
        locked(tmp_path),
        pytest.raises(ConfigurationError, match="another process uses this folder"),
    ):
        run_batch(tmp_path, jobs("physics"), here, **QUIET)
    (tmp_path / "missions.csv").write_text("mine\n")
    with pytest.raises(ConfigurationError, match="holds the results of a run"):
        run_batch(tmp_path, jobs("physics"), here, **QUIET)


def killed_batch(folder, jobs, here, seconds):
    """Run a batch in this process, which the kernel ends after some time, without a last word."""
    if measured := coverage.Coverage.current():
        measured.stop()  # a signal inside coverage's lock leaves it locked, for ever
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # pytest-timeout has a handler
    signal.setitimer(signal.ITIMER_REAL, seconds)
    run_batch(folder, jobs, here, **QUIET)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_batch_killed_many_times_gives_the_same_bytes(jobs, tmp_path, here):
    """Killed at random moments, also inside a save: SIGALRM ends a process as SIGKILL does."""
    two = jobs("physics", "oracle", seeds=[0], budget=20, **{"checkpoints.every": 0})
    whole, broken, chance = tmp_path / "whole", tmp_path / "broken", random.Random(0)
    run_batch(tmp_path / "first", two, here, **QUIET)  # what Python loads takes time once
    begin = time.monotonic()
    run_batch(whole, two, here, **QUIET)
    pace = time.monotonic() - begin

    def compare():
        assert results_of(broken) == results_of(whole)
        assert not [path for path in broken.rglob(".*") if path.name != ".lock"]  # no litter
        assert not [*broken.rglob("unfinished/*")]

    context, kills = multiprocessing.get_context("fork"), 0
    while kills < 8:
        batch = context.Process(
            target=killed_batch, args=(broken, two, here, pace * chance.uniform(0.05, 0.5))
        )
        batch.start()
        batch.join()
        if batch.exitcode == 0:  # it came to its end: once more from the beginning
            compare()
            shutil.rmtree(broken)
        else:
            assert batch.exitcode == -signal.SIGALRM
            kills += 1
    assert run_batch(broken, two, here, **QUIET) == {}
    compare()


def alive(pid):
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_jobs_end_with_a_command_that_is_killed(jobs, tmp_path, forked):
    two = jobs("physics", "oracle", seeds=[0], budget=3000, **{"checkpoints.every": 0})
    context = multiprocessing.get_context("fork")
    batch = context.Process(target=run_batch, args=(tmp_path, two, Executor(2)), kwargs=QUIET)
    batch.start()
    while len({path.parent for path in tmp_path.rglob("checkpoint-*")}) < 2:
        assert batch.is_alive()
        time.sleep(0.02)
    children = Path(f"/proc/{batch.pid}/task/{batch.pid}/children").read_text().split()
    batch.kill()
    batch.join()
    assert len(children) == 2
    while any(map(alive, children)):  # they complete their step, and write a checkpoint
        time.sleep(0.02)
    assert len([*tmp_path.glob("jobs/*/unfinished/checkpoint-*")]) >= 2
    assert not [*tmp_path.glob("jobs/*/manifest.json")]


@pytest.mark.slow
def test_an_interrupted_batch_ends_its_jobs_and_keeps_their_state(
    jobs, tmp_path, forked, here, monkeypatch
):
    two = jobs("physics", "oracle", seeds=[0], budget=60, **{"checkpoints.every": 0})
    whole = tmp_path / "whole"
    run_batch(whole, two, here, **QUIET)

    def interrupt(board):
        if len({path.parent for path in tmp_path.rglob("checkpoint-*")}) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Board, "look", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_batch(tmp_path / "two", two, Executor(2), **QUIET)
    monkeypatch.undo()
    assert multiprocessing.active_children() == []
    moved = (tmp_path / "two").rename(tmp_path / "moved")  # a folder may go on elsewhere
    assert len({path.parent for path in moved.rglob("checkpoint-*")}) == 2
    assert run_batch(moved, two, here, **QUIET) == {}
    assert results_of(moved) == results_of(whole)


def test_progress_is_a_line_off_a_terminal_and_live_in_one(monkeypatch, tmp_path, capsys):
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(executor.time, "monotonic", lambda: clock.now)
    monkeypatch.setattr("tqdm.std.time", lambda: clock.now)
    jobs = [Job(name, tmp_path / name, tmp_path) for name in ("a", "b")]

    def tell(job, share):
        (job.folder / "unfinished").mkdir(parents=True, exist_ok=True)
        (job.folder / "unfinished" / "progress.txt").write_text(str(share))

    said = []
    with Board(jobs, 3, True, said.append) as board:
        tell(jobs[0], 0.5)
        for clock.now in (1009.0, 1010.0, 1019.0):
            board.look()
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("jobs: 25 %") and line.endswith("1/3 jobs, 1 running")
        tell(jobs[0], 0.2)  # it began again; what is shown does not run backwards
        clock.now = 1020.0
        board.look()
        assert capsys.readouterr().err.startswith("jobs: 25 %")
        tell(jobs[0], 0.5)
        (jobs[0].folder / "log.txt").write_text("ensemble: held-out error 0.1\n")
        board.end(jobs[0], None)
        board.end(jobs[1], "why")
        assert said == ["[2/3] a: done\n  ensemble: held-out error 0.1", "[3/3] b: failed: why"]
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    with Board(jobs, 3, True, said.append) as board:
        clock.now += 1
        board.look()
        board.end(jobs[0], None)
    screen = capsys.readouterr()
    assert "jobs:  25 %" in screen.err and "1/3 jobs, 1 running" in screen.err
    assert "[2/3] a: done" in screen.out and len(said) == 2


def test_names_of_folders():
    assert file_name("a" * 500) != file_name("a" * 501) and len(file_name("a" * 500)) < 140
    for name in ("../up", "a/b", "..", ".hidden", "C:\\x", "a b"):
        assert file_name(name) != name and not {*file_name(name)} & {*"/\\ "}
        assert not file_name(name).startswith(".")


@pytest.mark.parametrize("count", [0, True, "all", 1.5])
def test_counts_of_jobs_that_cannot_be_used(count):
    with pytest.raises(ConfigurationError, match="hydra.launcher.n_jobs="):
        Executor(count)


def test_counts_of_jobs(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert [Executor(n).size for n in (3, -1, -2, -99)] == [3, 8, 7, 1]
