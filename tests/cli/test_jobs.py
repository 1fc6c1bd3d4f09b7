"""Jobs, each in a process of its own, from the command line."""

import os
import signal
import subprocess
import sys
import time

import pandas as pd
import pytest

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
    1: "cost: a bug",
    2: "its process ended with status 0 before its results were whole",
    3: "cost: MemoryError",
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
    names = [f"physics+cost._target_={cost}" for cost in COSTS]
    *lines, last = done.stderr.splitlines()
    assert last.startswith("afm-rl: 4 of 6 jobs failed (")
    assert sorted(lines) == sorted(f"afm-rl: {names[n]}: failed: {w}" for n, w in REASONS.items())
    assert done.returncode == 1
    finished = {path.parent.name for path in sweep.glob("jobs/*/manifest.json")}
    assert finished == {names[0], names[5]}
    assert "Traceback" in (sweep / "jobs" / names[3] / "log.txt").read_text()
    assert pd.read_csv(sweep / "missions.csv")["method"].tolist() == [names[0], names[5]]
    # A job alone gives the same bytes as the same job inside a sweep.
    alone = tmp_path / "alone"
    assert afm_rl(*command, f"label='{names[0]}'", f"hydra.run.dir={alone}").status == 0
    for name in ("missions.csv", "steps.parquet"):
        assert check_manifest(alone)[name] == check_manifest(sweep / "jobs" / names[0])[name]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["run", "study"])
def test_ctrl_c_keeps_what_was_done(process, program, tmp_path, kind):
    """Interrupted once on the way, and taken up by the same program under its other name."""
    settings = ["tracks=ethz_1", "regimes=[{v_gain: -1.0}]", "seeds=1", "budget=200"]
    settings += ["hydra.run.dir=mine", "method=physics", "figures=false", "tensorboard=false"]
    settings += ["study=ugv"] * (kind == "study")
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    how = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    folder = tmp_path / "mine"
    with subprocess.Popen(
        [program, *settings, "checkpoints.every=0"], cwd=tmp_path, env=env, **how
    ) as running:
        while not list(folder.rglob("checkpoint-*")):
            assert running.poll() is None
            time.sleep(0.02)
        running.send_signal(signal.SIGINT)
        said = running.stderr.read().splitlines()
    assert running.returncode == 130, said
    assert said[-1].startswith("afm-rl: interrupted; what was done is in")
    assert list(folder.rglob("checkpoint-*")) and not list(folder.rglob("missions.csv"))
    done = process(sys.executable, "-m", "afm_rl.cli", *settings)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.rstrip().endswith(f"Results: {folder}")
    assert len(pd.read_csv(folder / "missions.csv")) == 1
    assert not list(folder.rglob("checkpoint-*"))
