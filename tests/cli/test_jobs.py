"""Jobs of sweeps, each in a process of its own."""

import os
import signal
import sys
from itertools import pairwise

import pandas as pd
import pytest

from afm_rl.cli.launchers import child
from afm_rl.cli.launchers.job import Job, run

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
    1: "cost: a bug",
    2: "its process ended with status 0 before its results were whole",
    3: "MemoryError",
    4: "its process was ended by SIGKILL; was there enough memory?",
}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_jobs_that_fail_or_die_take_no_other_with_them(
    process, program, afm_rl, tmp_path, quick, monkeypatch
):
    (tmp_path / "sabotage.py").write_text(SABOTAGE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    command = ["method=physics", "budget=3", "trust=[sabotage]", *quick]
    done = process(program, "-m", *command, f"cost._target_={','.join(COSTS)}")
    (sweep,) = (tmp_path / "multirun").iterdir()
    *lines, last = done.stderr.splitlines()
    assert last == "afm-rl: 4 of 6 jobs failed; the same command tries them again"
    assert lines == [
        f"afm-rl: job {n} (cost._target_={COSTS[n]}): failed: {why} ({sweep}/{n}/log.txt)"
        for n, why in REASONS.items()
    ]
    assert done.returncode == 1
    finished = {path.parent.name for path in sweep.glob("*/finished")}
    assert finished == {path.parent.name for path in sweep.glob("*/missions.csv")} == {"0", "5"}
    assert "Traceback" in (sweep / "3" / "log.txt").read_text()
    # A job alone gives the same numbers as the same job inside a sweep, bit for bit.
    assert afm_rl(*command, f"hydra.run.dir={tmp_path}/alone").status == 0
    folders = (tmp_path / "alone", sweep / "0", sweep / "5")
    steps = [pd.read_parquet(folder / "steps.parquet") for folder in folders]
    for one, other in pairwise(steps):
        pd.testing.assert_frame_equal(one, other, check_exact=True)


@pytest.mark.slow
def test_a_job_is_taken_up_where_an_attempt_was_killed(tmp_path, quick):
    folder = tmp_path / "it's, a [folder]"
    folder.mkdir()
    (folder / "missions.csv").write_text("written before the attempt was killed, while drawing")
    job = Job(folder, "abc", "", ("method=physics", "budget=2", *quick), tmp_path)
    assert run(job) is None
    assert job.finished
    assert len(pd.read_csv(folder / "missions.csv")) == 1


def test_a_job_ends_with_its_parent(process, tmp_path):
    module = [sys.executable, "-m", "afm_rl.cli.launchers.child"]
    done = process(
        *module, tmp_path / "job", "abc", "method=physics"
    )  # its standard input has ended already
    assert done.returncode == -signal.SIGTERM
    assert not (tmp_path / "job" / "missions.csv").exists()


def test_the_end_of_the_parent_is_the_end_of_its_input(monkeypatch):
    ended = []
    monkeypatch.setattr(os, "read", lambda file, count: b"")
    monkeypatch.setattr(os, "kill", lambda *args: ended.append(args))
    child._end_with_parent()
    assert ended == [(os.getpid(), signal.SIGTERM)]
