"""Studies: killed at any moment, run again, extended, and with shards that fail."""

import io
import multiprocessing
import os
import random
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from omegaconf import OmegaConf
from rich.console import Console

from afm_rl.errors import ArtefactError, ConfigurationError
from afm_rl.missions import study_crew, study_progress
from afm_rl.missions.lock import locked
from afm_rl.missions.shard import Shard
from afm_rl.missions.study import run_study
from afm_rl.missions.study_progress import Board
from afm_rl.missions.study_tables import write_tables
from afm_rl.missions.study_worker import Report, Worker, work

QUIET = {"echo": lambda line: None}


@pytest.fixture(autouse=True)
def forked(monkeypatch):
    """Fork workers, which saves them the imports; the command line's tests spawn them."""
    fork = multiprocessing.get_context("fork")
    monkeypatch.setattr(study_crew.multiprocessing, "get_context", lambda kind: fork)


@pytest.fixture
def methods(configure, ring, spot, cache):
    """Make the configurations of a small study."""

    def make(*names, **settings):
        given = {"tracks": [ring, spot], "seeds": 2, "budget": 12, "cache": str(cache)}
        return [configure(f"method={name}", **{**given, **settings}) for name in names]

    return make


def files(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def test_what_a_study_leaves_behind(methods, tmp_path):
    said = []
    tmp_path = tmp_path / "study"
    outcome = run_study(tmp_path, methods("oracle", "physics"), workers=2, echo=said.append)
    assert outcome.failures == {}
    shards = [f"shards/{m}/{s}" for m in ("oracle", "physics") for s in (0, 1)]
    names = ("missions.csv", "steps.parquet", "measures.json")
    tables = {f"{shard}/{name}" for shard in shards for name in names}
    assert {name for name in files(tmp_path) if ".lock" not in name} == tables | {
        *("study.yaml", "missions.csv", "compute.csv"),
        *("config/oracle.yaml", "config/physics.yaml"),
    }
    missions = pd.read_csv(tmp_path / "missions.csv")
    assert missions["mission"].tolist() == list(range(8))
    assert missions["method"].tolist() == ["oracle"] * 4 + ["physics"] * 4
    assert missions["track"].tolist() == ["ring", "ring", "spot", "spot"] * 2
    assert missions["seed"].tolist() == [0, 1] * 4
    assert "seconds" not in missions and "seconds" in outcome.missions
    compute = pd.read_csv(tmp_path / "compute.csv")
    assert list(compute) == [
        *("method", "missions", "steps", "seconds", "missions_per_hour", "steps_per_second"),
    ]
    assert compute["missions"].tolist() == [4, 4]
    assert compute["steps"].tolist() == [2 * (12 + 3)] * 2
    assert compute["seconds"].gt(0).all()
    assert len(said) == 4 and sorted(line[:5] for line in said) == [
        f"[{k}/4]" for k in (1, 2, 3, 4)
    ]
    again = []
    run_study(tmp_path, methods("oracle", "physics"), echo=again.append)
    assert again == ["4 of 4 shards have results already"]


def test_a_shard_runs_as_its_missions_run_by_themselves(methods, drive, ring, spot, tmp_path):
    run_study(tmp_path, methods("physics", seeds=[3, 1]), workers=1, **QUIET)
    alone = drive("method=physics", tracks=[ring, spot], seeds=[3], budget=12)
    stored = pd.read_parquet(tmp_path / "shards" / "physics" / "3" / "steps.parquet")
    pd.testing.assert_frame_equal(stored, alone.steps, check_exact=True)
    assert pd.read_csv(tmp_path / "missions.csv")["seed"].tolist() == [1, 3, 1, 3]


def test_more_seeds_and_methods_extend_a_study(methods, tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    run_study(one, methods("oracle", seeds=1), **QUIET)
    run_study(one, methods("oracle", "physics", seeds=[1]), **QUIET)
    assert len(pd.read_csv(one / "missions.csv")) == 6
    run_study(one, methods("physics", seeds=[0]), **QUIET)
    run_study(other, methods("oracle", "physics"), **QUIET)
    for name in ("missions.csv", "study.yaml"):
        assert (one / name).read_bytes() == (other / name).read_bytes()
    assert OmegaConf.load(one / "config" / "physics.yaml").seeds == [0, 1]


def test_a_study_with_other_settings_is_refused(methods, tmp_path):
    run_study(tmp_path, methods("physics", seeds=1), **QUIET)
    before = {name: (tmp_path / name).read_bytes() for name in files(tmp_path)}
    others = methods("physics", "oracle", **{"planner.population": 17, "progress": False})
    with pytest.raises(ConfigurationError) as found:
        run_study(tmp_path, others, **QUIET)
    assert str(found.value) == (
        f"hydra.run.dir={tmp_path}: holds a study with other settings (planner.population: 16 -> "
        "17); choose another folder"
    )
    assert {name: (tmp_path / name).read_bytes() for name in files(tmp_path)} == before


def test_a_study_of_another_version_is_refused(methods, tmp_path, monkeypatch):
    run_study(tmp_path, methods("physics", seeds=1), **QUIET)
    monkeypatch.setattr("afm_rl.missions.study_record.__version__", "99")
    with pytest.raises(ConfigurationError, match=r"\(version: .* -> 99\)"):
        run_study(tmp_path, methods("physics", seeds=1), **QUIET)


def test_results_of_something_else_are_left_alone(methods, tmp_path):
    (tmp_path / "missions.csv").write_text("mine\n")
    with pytest.raises(ConfigurationError, match="results of something else"):
        run_study(tmp_path, methods("physics"), **QUIET)
    assert (tmp_path / "missions.csv").read_text() == "mine\n"


@pytest.mark.parametrize("text", ["", "a: [", "seeds: 3", b"\xff"])
def test_a_damaged_record_is_refused(methods, tmp_path, text):
    (tmp_path / "study.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ArtefactError, match=r"study\.yaml: damaged"):
        run_study(tmp_path, methods("physics"), **QUIET)


def test_a_second_study_in_the_same_folder_is_refused(methods, tmp_path):
    with locked(tmp_path), pytest.raises(ConfigurationError, match="another process is at work"):
        run_study(tmp_path, methods("physics"), **QUIET)


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="cannot write .*file/study"):
        with locked(tmp_path / "file" / "study"):
            pass


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"workers": 0}, "study.workers=0"),
        ({"every": -1.0}, "study.every=-1.0"),
        ({"label": "a/b"}, "label='a/b'"),
        ({"label": ".."}, "label='..'"),
        ({"label": None}, "label=None"),
    ],
)
def test_settings_that_cannot_be_used(methods, tmp_path, settings, named):
    chosen = methods("physics")
    if "label" in settings:
        chosen[0].label = settings.pop("label")
    with pytest.raises(ConfigurationError, match=named):
        run_study(tmp_path / "study", chosen, **settings, **QUIET)
    assert files(tmp_path) == {"ring.csv", "spot.csv"}


def test_shards_that_fail_do_not_take_the_others_down(methods, tmp_path, monkeypatch):
    real = study_crew.work

    def fragile(pipe, parent, study, texts, every):
        def run_shard(study, shard, cfg, every, watch):
            if shard == ("oracle", 0):
                os.kill(os.getpid(), signal.SIGKILL)
            if shard == ("oracle", 1):
                os._exit(3)
            if shard == ("physics", 0):
                from afm_rl.missions import shard as module

                module.build = lambda cfg: 1 / 0
            return whole(study, shard, cfg, every, watch)

        from afm_rl.missions import study_worker

        whole, study_worker.run_shard = study_worker.run_shard, run_shard
        real(pipe, parent, study, texts, every)

    said = []
    with monkeypatch.context() as patched:
        patched.setattr(study_crew, "work", fragile)
        outcome = run_study(tmp_path, methods("oracle", "physics"), workers=3, echo=said.append)
    assert outcome.failures.keys() - {("physics", 1)} == {
        *(("oracle", 0), ("oracle", 1), ("physics", 0)),
    }
    assert "SIGKILL" in outcome.failures[Shard("oracle", 0)]
    assert "status 3" in outcome.failures[Shard("oracle", 1)]
    assert outcome.failures[Shard("physics", 0)] == "ZeroDivisionError: division by zero"
    assert "1 / 0" in (tmp_path / "shards" / "physics" / "0" / "error.txt").read_text()
    assert any("oracle, seed 0: failed: its process was ended by SIGKILL" in line for line in said)
    outcome = run_study(tmp_path, methods("oracle", "physics"), **QUIET)
    assert outcome.failures == {} and len(outcome.missions) == 8
    assert not (tmp_path / "shards" / "physics" / "0" / "error.txt").exists()


def test_tables_of_nothing(tmp_path):
    assert write_tables(tmp_path, [Shard("physics", 0)]).empty
    assert files(tmp_path) == set()


def test_an_interrupted_study_ends_its_workers_and_keeps_their_state(methods, tmp_path):
    def interrupt(line):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(
            tmp_path, methods("oracle", "physics", budget=150), workers=2, every=99, echo=interrupt
        )
    kept = list(tmp_path.glob("shards/*/*/checkpoint.safetensors"))
    assert kept
    assert multiprocessing.active_children() == []
    interrupted = run_study(tmp_path, methods("oracle", "physics", budget=150), **QUIET)
    assert interrupted.failures == {}
    assert list(tmp_path.glob("shards/*/*/checkpoint.safetensors")) == []


def children(pid):
    text = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(child) for child in text.read_text().split()] if text.exists() else []


def alive(pid):
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_study_killed_ten_times_gives_the_same_tables(methods, tmp_path):
    """Real processes, real SIGKILLs, at random moments."""
    chosen = methods("physics", "oracle", tracks=methods("physics")[0].tracks[:1], budget=60)
    whole, broken, chance = tmp_path / "whole", tmp_path / "broken", random.Random(0)
    run_study(whole, chosen, workers=2, **QUIET)
    context = multiprocessing.get_context("fork")
    ended = 0
    for _ in range(10):
        study = context.Process(
            target=run_study, args=(broken, chosen), kwargs={"workers": 2, "every": 0, **QUIET}
        )
        study.start()
        study.join(chance.uniform(0.1, 0.7))
        orphans = children(study.pid)
        ended += study.exitcode is not None
        study.kill()
        study.join()
        latest = time.monotonic() + 10
        while any(map(alive, orphans)):
            assert time.monotonic() < latest, "an orphan went on"
            time.sleep(0.02)
    assert ended < 8
    assert run_study(broken, chosen, workers=2, **QUIET).failures == {}
    assert (broken / "missions.csv").read_bytes() == (whole / "missions.csv").read_bytes()
    for shard in whole.glob("shards/*/*"):
        other = broken / shard.relative_to(whole)
        assert files(other) == files(shard)
        steps = [pd.read_parquet(folder / "steps.parquet") for folder in (shard, other)]
        pd.testing.assert_frame_equal(*steps, check_exact=True)


class Pipe:
    """The worker's end of a pipe, filled beforehand."""

    def __init__(self, *shards):
        self.shards, self.sent = list(shards), []

    def poll(self, seconds):
        return bool(self.shards)

    def recv(self):
        return self.shards.pop(0)

    def send(self, report):
        self.sent.append(report)


@pytest.fixture
def worker(methods, tmp_path, monkeypatch):
    """Make a worker in this process."""
    monkeypatch.setattr("afm_rl.missions.study_worker.REPORT", 0.0)

    def make(*shards, parent=None, **settings):
        (cfg,) = methods("physics", **settings)
        texts = {"physics": OmegaConf.to_yaml(cfg)}
        return Worker(Pipe(*shards), parent or os.getppid(), tmp_path, texts, 60.0)

    return make


def test_a_worker_reports_and_ends_when_there_is_nothing_left(worker, tmp_path):
    busy = worker(Shard("physics", 0), None)
    busy.work()
    *steps, last = busy.pipe.sent
    assert last == Report(over=True)
    assert len(steps) == 12 and steps[-1].share == 1
    assert [report.finished for report in steps] == [0, 0] + [1] * 9 + [2]
    assert steps[-1].rows == 12 + 3 - 2 and steps[-1].seconds > 0
    assert Shard("physics", 0).finished(tmp_path)


def test_a_worker_whose_parent_has_died_ends_within_a_step(worker, tmp_path, monkeypatch):
    orphan = worker(Shard("physics", 0))
    sent = orphan.pipe.sent
    monkeypatch.setattr(os, "getppid", lambda: orphan.parent if len(sent) < 3 else 1)
    orphan.work()
    assert len(sent) == 3
    assert (tmp_path / "shards" / "physics" / "0" / "checkpoint.safetensors").exists()
    worker(Shard("physics", 0), parent=-1).work()  # not even begun


def test_a_worker_that_is_told_to_stop(worker, monkeypatch):
    idle = worker()
    monkeypatch.setattr(idle.pipe, "poll", lambda seconds: idle.stop() or False)
    idle.work()
    assert idle.pipe.sent == []


def test_a_worker_says_why_a_shard_failed(worker):
    busy = worker(Shard("physics", 0), None, budget=0)
    busy.work()
    (report,) = busy.pipe.sent
    assert report.over and "ConfigurationError: budget=0" in report.failure


@pytest.mark.parametrize("error", [BrokenPipeError, EOFError])
def test_the_process_of_a_worker(tmp_path, monkeypatch, error):
    def gone(self):
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
        raise error

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(Worker, "work", gone)
    try:
        work(Pipe(), os.getppid(), tmp_path, {}, 60.0)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def test_live_progress_has_a_line_per_method(monkeypatch):
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=120)
    monkeypatch.setattr(study_progress, "Console", lambda stderr: console)
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(study_progress.time, "monotonic", lambda: clock.now)
    shards = [Shard(method, seed) for seed in range(4) for method in ("physics", "oracle")]
    said = []
    with Board(shards, shards[:1], cells=10, live=True, echo=said.append) as board:
        board.hear(shards[2], Report(), "")
        clock.now = 60.0
        board.hear(shards[2], Report(finished=3, share=0.5, rows=6000, seconds=50.0), "")
        assert "13/40 missions, 120 steps/s, 1:00 so far, 5:00 left" in screen.getvalue()
        board.hear(shards[2], Report(over=True), "never said")
        board.hear(shards[3], Report(over=True, failure="why"), "oracle, seed 1: failed: why")
    shown = screen.getvalue()
    assert "oracle" in shown and "0/40 missions" in shown and "20/40 missions" in shown
    assert "oracle, seed 1: failed: why" in shown and "never said" not in shown
    assert said == []


def test_methods_stand_in_the_order_asked_for_in_a_partial_study(methods, tmp_path):
    run_study(tmp_path, methods("physics", seeds=[1]), **QUIET)
    run_study(tmp_path, methods("oracle", "physics", seeds=[0]), **QUIET)
    missions = pd.read_csv(tmp_path / "missions.csv")
    assert missions["method"].tolist() == ["oracle"] * 2 + ["physics"] * 4
    write_tables(tmp_path, [Shard("physics", 1), Shard("oracle", 0)])
    assert (
        pd.read_csv(tmp_path / "missions.csv")["method"].tolist()
        == ["physics"] * 2 + ["oracle"] * 2
    )


def test_parts_are_trained_once_before_the_workers_start(methods, tmp_path):
    said = []
    chosen = methods("physics", "afm_physics", budget=3, cache=str(tmp_path / "parts"))
    run_study(tmp_path / "study", chosen, workers=2, echo=said.append)
    assert said[0] == "afm_physics:" and "trained in" in said[1]
    assert len(list((tmp_path / "parts").iterdir())) == 1
    assert sum("seed" in line for line in said) == 4
