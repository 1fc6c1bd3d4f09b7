"""Batches: killed at any moment, run again, extended, and with jobs that fail."""

import faulthandler
import io
import json
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
from rich.console import Console

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.jobs import process, progress
from afm_rl.jobs.batch import file_name, run_batch
from afm_rl.jobs.layout import run_folders
from afm_rl.jobs.local import LocalPool
from afm_rl.jobs.process import Job
from afm_rl.jobs.progress import Board
from afm_rl.jobs.tables import read_missions, read_steps
from afm_rl.storage.files import locked
from afm_rl.storage.manifest import check_manifest

QUIET = {"echo": lambda line: None}
SAME = ("missions.csv", "steps.parquet")


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


def test_what_a_batch_leaves_behind(jobs, tmp_path):
    said, four = [], jobs("oracle", "physics")
    assert run_batch(tmp_path, four, LocalPool(2), command="afm-rl x", echo=said.append) == {}
    assert sorted(said) == sorted(f"[{k}/4] {said[k - 1].split()[1]} done" for k in range(1, 5))
    record = yaml.safe_load((tmp_path / "jobs.yaml").read_text())
    assert record == {"command": "afm-rl x", "jobs": [*four]}
    assert check_manifest(tmp_path).keys() == {"jobs.yaml", "missions.csv", "compute.csv"}
    for run in run_folders(tmp_path):
        assert "missions.csv" in check_manifest(run) and not (run / "unfinished").exists()
    missions = pd.read_csv(tmp_path / "missions.csv")
    assert missions["mission"].tolist() == [0, 1, 2, 3]
    assert missions["method"].tolist() == ["oracle"] * 2 + ["physics"] * 2
    assert missions["seed"].tolist() == [0, 1] * 2 and "seconds" not in missions
    compute = pd.read_csv(tmp_path / "compute.csv")
    assert compute["missions"].tolist() == [2, 2] and compute["steps"].tolist() == [24, 24]
    steps = read_steps(tmp_path)
    assert steps.groupby("mission").size().tolist() == [12] * 4
    assert read_missions(tmp_path)["seconds"].gt(0).all()
    again = []
    run_batch(tmp_path, four, LocalPool(), echo=again.append)
    assert again == ["4 of 4 jobs have results already"]


def test_more_jobs_extend_a_batch(jobs, tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    run_batch(one, jobs("oracle", seeds=[0]), LocalPool(2), **QUIET)
    run_batch(one, jobs("oracle", "physics"), LocalPool(2), **QUIET)
    run_batch(other, jobs("oracle", "physics"), LocalPool(2), **QUIET)
    assert (one / "missions.csv").read_bytes() == (other / "missions.csv").read_bytes()
    run_batch(one, jobs("physics"), LocalPool(2), **QUIET)  # the others stay, after these
    assert len(pd.read_csv(one / "missions.csv")) == 4


def test_nothing_is_changed_if_one_job_has_other_settings(jobs, tmp_path):
    run_batch(tmp_path, jobs("physics", seeds=[0]), LocalPool(1), **QUIET)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(ConfigurationError, match=r"budget: 12 -> 13"):
        run_batch(tmp_path, jobs("oracle", "physics", budget=13), LocalPool(1), **QUIET)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_damaged_results_stop_a_batch_and_are_named(jobs, tmp_path):
    run_batch(tmp_path, jobs("physics", seeds=[0]), LocalPool(1), **QUIET)
    path = tmp_path / "jobs" / "physics+seed=0" / "missions.csv"
    path.write_bytes(path.read_bytes().replace(b"0", b"1", 1))
    with pytest.raises(ArtefactError, match=f"{path.name}: damaged"):
        run_batch(tmp_path, jobs("physics"), LocalPool(1), **QUIET)


def test_folders_that_are_taken(jobs, tmp_path):
    with locked(tmp_path), pytest.raises(ConfigurationError, match="another process is at work"):
        run_batch(tmp_path, jobs("physics"), LocalPool(1), **QUIET)
    (tmp_path / "missions.csv").write_text("mine\n")
    with pytest.raises(ConfigurationError, match="holds the results of a run"):
        run_batch(tmp_path, jobs("physics"), LocalPool(1), **QUIET)


def test_jobs_that_fail_do_not_take_the_others_down(jobs, tmp_path, monkeypatch):
    monkeypatch.setattr(process, "START", "fork")  # jobs inherit what is patched
    real = process._finish

    def fragile(folder):
        if folder.name == "oracle+seed=0":
            os.kill(os.getpid(), signal.SIGKILL)
        if folder.name == "oracle+seed=1":
            os._exit(3)
        if folder.name == "physics+seed=0":
            raise MemoryError
        if folder.name == "physics+seed=1":
            raise RuntimeError("a\nbug")
        real(folder)

    said, six = [], jobs("oracle", "physics") | jobs("physics", seeds=[8, 9])
    with monkeypatch.context() as patched:
        patched.setattr(process, "_finish", fragile)
        failures = run_batch(tmp_path, six, LocalPool(3), echo=said.append)
    assert failures == {
        "oracle+seed=0": "its process was ended by SIGKILL; was there enough memory?",
        "oracle+seed=1": "its process ended with status 3 before its results were whole",
        "physics+seed=0": "MemoryError",
        "physics+seed=1": "RuntimeError: a bug",
    }
    assert "[6/6]" in said[-1] and sum("failed: " in line for line in said) == 4
    assert "Traceback" in (tmp_path / "jobs" / "physics+seed=0" / "log.txt").read_text()
    assert len(pd.read_csv(tmp_path / "missions.csv")) == 2
    assert run_batch(tmp_path, six, LocalPool(2), **QUIET) == {}
    assert len(pd.read_csv(tmp_path / "missions.csv")) == 6


@pytest.mark.timeout(10)
def test_errors_that_name_each_other_as_their_cause_are_explained():
    one, other = KeyError("one"), ConfigurationError("seeds=0: expected more")
    one.__cause__, other.__context__ = other, one  # omegaconf raises such rings
    assert process.explain(one) == "seeds=0: expected more"
    bug = RuntimeError("a bug")
    bug.__context__ = bug
    assert process.explain(bug) == "RuntimeError: a bug"


def children(pid):
    text = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(child) for child in text.read_text().split()] if text.exists() else []


def alive(pid):
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def forking_batch(folder, jobs, stacks):
    """Run a batch that forks its jobs, from a process that has one thread only."""
    if measured := coverage.Coverage.current():
        measured.stop()  # a signal inside coverage's lock leaves it locked, for ever
    process.START = "fork"
    faulthandler.register(signal.SIGUSR1, stacks.open("a"))
    run_batch(folder, jobs, LocalPool(2), **QUIET)


@pytest.mark.timeout(600)
def test_a_batch_killed_twenty_times_gives_the_same_bytes(jobs, tmp_path):
    """Real processes, real SIGKILLs of all of them, at random moments, also inside a save."""
    two = jobs("physics", "oracle", seeds=[0], budget=300, **{"checkpoints.every": 0})
    whole, broken, chance = tmp_path / "whole", tmp_path / "broken", random.Random(0)
    run_batch(whole, two, LocalPool(2), **QUIET)

    def compare():
        for name in SAME:
            for run, other in zip(run_folders(whole), run_folders(broken), strict=True):
                assert (run / name).read_bytes() == (other / name).read_bytes()
        assert (whole / "missions.csv").read_bytes() == (broken / "missions.csv").read_bytes()
        assert not [path for path in broken.rglob(".*") if path.name != ".lock"]  # no litter

    context, stacks = multiprocessing.get_context("forkserver"), tmp_path / "stacks.txt"
    kills = 0
    while kills < 20:
        batch = context.Process(target=forking_batch, args=(broken, two, stacks))
        batch.start()
        batch.join(chance.uniform(0.2, 0.5))
        if batch.exitcode is not None:  # it came to its end: once more from the beginning
            compare()
            shutil.rmtree(broken)
            continue
        orphans = children(batch.pid)
        victims = orphans if chance.random() < 0.5 else []  # else they end by themselves
        for victim in [batch.pid, *victims]:
            os.kill(victim, signal.SIGKILL)
        batch.join()
        kills += 1
        latest = time.monotonic() + 120  # it may still be starting, on a slow machine
        while left := [orphan for orphan in orphans if alive(orphan)]:
            if time.monotonic() > latest:
                os.kill(left[0], signal.SIGUSR1)
                time.sleep(1.0)
                pytest.fail(f"an orphan went on:\n{stacks.read_text()}")
            time.sleep(0.02)
    assert run_batch(broken, two, LocalPool(2), **QUIET) == {}
    compare()


def test_an_interrupted_batch_ends_its_jobs_and_keeps_their_state(jobs, tmp_path):
    two = jobs("physics", "oracle", seeds=[0], budget=300, **{"checkpoints.every": 0})

    class Interrupted(LocalPool):
        def run(self, waiting):
            for end in super().run(waiting):
                if len({path.parent for path in tmp_path.rglob("checkpoint-*")}) == 2:
                    raise KeyboardInterrupt
                yield end

    with pytest.raises(KeyboardInterrupt):
        run_batch(tmp_path, two, Interrupted(2), **QUIET)
    assert len({path.parent for path in tmp_path.rglob("checkpoint-*")}) == 2
    assert multiprocessing.active_children() == []
    assert run_batch(tmp_path, two, LocalPool(2), **QUIET) == {}
    assert list(tmp_path.glob("jobs/*/unfinished")) == []


def test_progress_is_live_in_a_terminal_and_a_line_elsewhere(monkeypatch, tmp_path):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=120)
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock.now)
    jobs = [Job(name, tmp_path / name, tmp_path) for name in ("a", "b")]

    def tell(job, share):
        (job.folder / "unfinished").mkdir(parents=True, exist_ok=True)
        state = {"line": f"step {share}", "share": share}
        (job.folder / "unfinished" / "progress.json").write_text(json.dumps(state))

    tell(jobs[0], 0.5)
    said = []
    with Board(jobs, 3, True, said.append) as board:
        for clock.now in (9.0, 10.0, 19.0):
            board.look()
        assert said == ["1/3 jobs, 1 at work, 25 %, 0:10 so far"]
        (jobs[0].folder / "log.txt").write_text("ensemble: held-out error 0.1\n")
        board.end(jobs[0], None)
        clock.now = 20.0
        board.look()
        board.end(jobs[1], "why")
        assert said[1:] == [
            "[2/3] a: done\n  ensemble: held-out error 0.1",
            "2/3 jobs, 0 at work, 50 %, 0:20 so far, 0:40 left",
            "[3/3] b: failed: why",
        ]
    monkeypatch.setattr(progress, "Console", lambda stderr: console)
    with Board(jobs, 3, True, said.append) as board:
        clock.now += 1
        board.look()
        board.end(jobs[0], None)
    assert "step 0.5" in screen.getvalue() and "[2/3] a: done" in screen.getvalue()
    assert len(said) == 4


def test_names_of_folders():
    assert file_name("a" * 500) != file_name("a" * 501) and len(file_name("a" * 500)) < 140
    assert file_name("..") != ".." and "/" not in file_name("a/../b")


@pytest.mark.parametrize("count", [0, True, "all", 1.5])
def test_counts_of_jobs_that_cannot_be_used(count):
    with pytest.raises(ConfigurationError, match="hydra.launcher.n_jobs="):
        LocalPool(count)


def test_counts_of_jobs(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert [LocalPool(n).size for n in (3, -1, -2, -99)] == [3, 8, 7, 1]
