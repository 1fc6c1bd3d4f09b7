"""Jobs, each in a process of its own, from the command line."""

import multiprocessing
import os
import signal
import sys
import time

import coverage
import pandas as pd
import pytest

from afm_rl import cli
from afm_rl.storage.manifest import check_manifest

SABOTAGE = """
import os, signal
from afm_rl.planning import GoalDistance

class Fails(GoalDistance):
    def forward(self, *args): raise RuntimeError("a bug")

class Leaves(GoalDistance):
    def forward(self, *args): os._exit(0)

class Exhausts(GoalDistance):
    def forward(self, *args): raise MemoryError

class Dies(GoalDistance):
    def forward(self, *args): os.kill(os.getpid(), signal.SIGKILL)
"""
COSTS = [
    *("afm_rl.planning.GoalDistance", "sabotage.Fails", "sabotage.Leaves", "sabotage.Exhausts"),
    *("sabotage.Dies", "afm_rl.planning.costs.GoalDistance"),
]
REASONS = {
    1: "cost: fails for states (5, 1, 3): a bug",
    2: "its process ended with status 0 before its results were complete",
    3: "cost: fails for states (5, 1, 3): MemoryError",
    4: "its process was ended by SIGKILL; was there enough memory?",
}


@pytest.mark.slow
def test_jobs_that_fail_or_die_take_no_other_with_them(afm_rl, tmp_path, quick, monkeypatch):
    (tmp_path / "sabotage.py").write_text(SABOTAGE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    command = ["method=physics", "budget=3", "trust=[sabotage]", *quick]
    done = afm_rl("-m", *command, f"cost._target_={','.join(COSTS)}")
    (sweep,) = (tmp_path / "multirun").iterdir()
    names = [f"physics+cost._target_={cost}" for cost in COSTS]
    *lines, last = done.err.splitlines()
    assert last.startswith("afm-rl: 4 of 6 jobs failed (")
    assert sorted(lines) == sorted(f"afm-rl: {names[n]}: failed: {w}" for n, w in REASONS.items())
    assert done.status == 1
    finished = {path.parent.name for path in sweep.glob("jobs/*/manifest.json")}
    assert finished == {names[0], names[5]}
    assert "Traceback" in (sweep / "jobs" / names[3] / "log.txt").read_text()
    assert pd.read_csv(sweep / "missions.csv")["method"].tolist() == [names[0], names[5]]
    # A job alone gives the same bytes as the same job inside a sweep.
    alone = tmp_path / "alone"
    assert afm_rl(*command, f"label='{names[0]}'", f"hydra.run.dir={alone}").status == 0
    for name in ("missions.csv", "steps.parquet"):
        assert check_manifest(alone)[name] == check_manifest(sweep / "jobs" / names[0])[name]


def command_line(arguments, log):
    """Be the command line, in a process of its own."""
    if measured := coverage.Coverage.current():
        measured.stop()  # a signal inside coverage's lock leaves it locked, for ever
    for number in (1, 2):
        os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout = sys.stderr = open(2, "w", buffering=1, closefd=False)
    sys.argv[1:] = arguments
    cli.main()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["run", "study"])
def test_ctrl_c_keeps_what_was_done(afm_rl, tmp_path, kind, monkeypatch):
    """Interrupted once on the way, and taken up by the same command."""
    monkeypatch.chdir(tmp_path)
    settings = ["tracks=ethz_1", "regimes=[{v_gain: -1.0}]", "seeds=1", "budget=100"]
    settings += ["hydra.run.dir=mine", "method=physics", "figures=false", "progress=false"]
    settings += ["tensorboard=false"]
    settings += ["study=ugv"] * (kind == "study")
    folder, log = tmp_path / "mine", tmp_path / "log.txt"
    started = [*settings, "checkpoints.every=0"], log
    running = multiprocessing.get_context("fork").Process(target=command_line, args=started)
    running.start()
    while not list(folder.rglob("checkpoint-*")):
        assert running.is_alive(), log.read_text()
        time.sleep(0.02)
    os.kill(running.pid, signal.SIGINT)
    running.join()
    said = log.read_text().splitlines()
    assert running.exitcode == 130, said
    assert said[-1].startswith("afm-rl: interrupted; the results so far are in")
    assert list(folder.rglob("checkpoint-*")) and not list(folder.rglob("missions.csv"))
    done = afm_rl(*settings)
    assert (done.status, done.err) == (0, "")
    assert done.out.rstrip().endswith(f"Results: {folder}")
    assert len(pd.read_csv(folder / "missions.csv")) == 1
    assert not list(folder.rglob("checkpoint-*"))
