"""Sweeps: which jobs are run, where they go, and what is said of them."""

import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
import yaml

from afm_rl.cli import results
from afm_rl.cli.overrides import with_sweep_folder
from afm_rl.jobs.executor import Executor
from afm_rl.storage.manifest import write_manifest

SWEEP = ["-m", "method=physics", "planner.horizon=3,5"]
WORSE = "hydra.sweeper.direction=minimize"


def pretend(job):
    """Leave results without having run anything."""
    new = job.folder / "unfinished"
    label = yaml.safe_load((new / "config.yaml").read_text())["label"]
    row = {"mission": 0, "method": label, "seed": 0, "steps": 4}
    pd.DataFrame([row]).to_csv(job.folder / "missions.csv", index=False)
    row = {"method": label, "missions": 1, "steps": 5, "seconds": 1.0}
    pd.DataFrame([row]).to_csv(job.folder / "compute.csv", index=False)
    (new / "config.yaml").rename(job.folder / "config.yaml")
    new.rmdir()
    write_manifest(job.folder)


@pytest.fixture
def ran(monkeypatch):
    """Have jobs done at once, unless ``failing`` names one; return what was run."""
    calls = SimpleNamespace(jobs=[], failing="none")

    def start(self, job):
        calls.jobs.append(job)
        if calls.failing not in job.name:
            pretend(job)
        return SimpleNamespace(is_alive=lambda: False, exitcode=3)

    monkeypatch.setattr(Executor, "start", start)
    monkeypatch.setattr(results, "show_sweep", lambda folder, *_: print(f"Results: {folder}"))
    monkeypatch.setattr(results, "first_measure", lambda folders, _: len(folders))
    return calls


@pytest.fixture
def sweep(afm_rl, tmp_path, monkeypatch):
    """Run a sweep in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return lambda *settings: afm_rl(*settings, f"hydra.sweep.dir={tmp_path}/sweep")


def names(ran):
    found = [job.folder.name for job in ran.jobs]
    ran.jobs.clear()
    return found


def test_every_job_has_a_folder_that_is_named_after_it(sweep, ran, tmp_path):
    done = sweep(*SWEEP, "hydra/launcher=local")
    assert (done.status, done.err) == (0, "")
    both = ["physics+planner.horizon=3", "physics+planner.horizon=5"]
    assert names(ran) == both
    record = yaml.safe_load((tmp_path / "sweep" / "jobs.yaml").read_text())
    assert record["jobs"] == both and record["command"].startswith("afm-rl -m method=physics")
    stored = yaml.safe_load((tmp_path / "sweep" / "jobs" / both[1] / "config.yaml").read_text())
    assert stored["label"] == both[1] and stored["planner"]["horizon"] == 5
    assert pd.read_csv(tmp_path / "sweep" / "missions.csv")["method"].tolist() == both
    assert "[2/2] physics+planner.horizon=5: done" in done.out
    assert done.out.rstrip().endswith(f"Results: {tmp_path}/sweep")


def test_finished_jobs_are_skipped_and_others_are_not(sweep, ran, tmp_path):
    ran.failing = "planner.horizon=5"
    done = sweep(*SWEEP)
    assert done.status == 1
    assert done.err == (
        "afm-rl: physics+planner.horizon=5: failed: its process ended with status 3 before its "
        "results were complete\n"
        f"afm-rl: 1 of 2 jobs failed ({tmp_path}/sweep/jobs/*/log.txt); the same command tries "
        "them again\n"
    )
    ran.failing = "none"
    ran.jobs.clear()
    done = sweep(*SWEEP, "hydra/launcher=local", "progress=false")  # neither makes another job
    assert done.status == 0 and "1 of 2 jobs have results already" in done.out
    assert names(ran) == ["physics+planner.horizon=5"]
    assert sweep(*SWEEP).status == 0 and ran.jobs == []
    assert sweep(*SWEEP, "overwrite=true").status == 0 and len(ran.jobs) == 2


def test_a_sweep_is_extended_and_other_settings_replace_nothing(sweep, ran):
    assert sweep("-m", "method=physics", "seeds=1,2").status == 0
    assert sweep("-m", "method=physics", "seeds=3,1,3").status == 0  # and none of them twice
    assert names(ran) == [f"physics+seeds={seed}" for seed in (1, 2, 3)]
    done = sweep("-m", "method=physics", "seeds=1,2", "budget=7")
    assert done.status == 2 and "budget: 5000 -> 7" in done.err and done.err.count("\n") == 1
    assert ran.jobs == []


def test_methods_seeds_and_settings_make_the_names(sweep, ran, tmp_path):
    assert sweep("-m", "compare=[physics,oracle]", "budget=5,6").status == 0
    labels = [f"{method}+budget={budget}" for budget in (5, 6) for method in ("physics", "oracle")]
    assert names(ran) == labels
    assert sweep("-m", "method=physics,oracle", "label=mine", "budget=8").status == 0
    assert names(ran) == ["mine+method=physics", "mine+method=oracle"]
    study = ["study=ugv", "compare=[physics]", "seeds=[4]", "tracks=ethz_1,ethz_2"]
    assert sweep("-m", *study).status == 0
    assert names(ran) == [f"physics+tracks=ethz_{track}+seed=4" for track in (1, 2)]
    settings = tmp_path / "sweep" / "jobs" / "physics+tracks=ethz_1+seed=4" / "config.yaml"
    assert yaml.safe_load(settings.read_text())["label"] == "physics"


def test_a_sweep_gives_a_setting_to_the_methods_that_have_it(sweep, ran, tmp_path):
    done = sweep("-m", "method=physics,online_pe", "dynamics.pretrain.samples=300")
    assert done.status == 0, done.err
    note = "physics: has no dynamics.pretrain.samples, so this setting does not change it"
    assert done.out.count(note) == 1
    assert names(ran) == ["physics", "online_pe"]
    stored = (tmp_path / "sweep" / "jobs" / "online_pe" / "config.yaml").read_text()
    assert yaml.safe_load(stored)["dynamics"]["pretrain"]["samples"] == 300


def test_a_method_without_a_swept_setting_has_one_job(sweep, ran):
    swept = "dynamics.pretrain.samples=300,400"
    assert sweep("-m", "method=physics,online_pe", swept, "agent=paper").status == 0
    labels = [f"online_pe+dynamics.pretrain.samples={n}" for n in (300, 400)]
    assert names(ran) == ["physics", *labels]


SEVERAL = {
    "sweep": ["-m", "method=physics,oracle"],
    "comparison": ["compare=[physics,oracle]"],
    "study": ["study=ugv", "compare=[physics,oracle]"],
}


@pytest.mark.parametrize("several", SEVERAL)
def test_a_setting_that_none_of_several_methods_has_is_refused(sweep, ran, several):
    done = sweep(*SEVERAL[several], "dynamics.membrs=3")
    assert (done.status, ran.jobs) == (2, [])
    assert several == "sweep" or done.out == ""
    assert done.err == "afm-rl: dynamics.membrs=3: none of physics, oracle has dynamics.membrs\n"


def test_a_setting_that_cannot_be_resolved_is_the_job_s_own_failure(sweep, ran):
    done = sweep("-m", "method=physics", "budget=${nope},5")
    assert done.status == 1 and names(ran) == ["physics+budget=5"]
    assert "nope" in done.err and "1 of 2 jobs failed" in done.err


def test_an_own_configuration_goes_to_the_jobs(sweep, ran, tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "mine.yaml").write_text("defaults: [config, _self_]\nbudget: 9\n")
    own = [f"--config-dir={tmp_path}/own", "--config-name=mine"]
    assert sweep("-m", *own, "seeds=1,2", "compare=[physics]").status == 0
    stored = (tmp_path / "sweep" / "jobs" / "physics+seeds=1" / "config.yaml").read_text()
    assert yaml.safe_load(stored)["budget"] == 9


def test_an_interrupted_sweep_says_how_to_go_on(sweep, monkeypatch, tmp_path):
    def interrupt(self, job):
        raise KeyboardInterrupt

    monkeypatch.setattr(Executor, "start", interrupt)
    done = sweep(*SWEEP, "hydra/launcher=local")
    assert done.status == 130 and done.err.count("\n") == 1
    assert done.err.startswith(f"afm-rl: interrupted; the results so far are in {tmp_path}/sweep")


def test_the_same_command_returns_to_the_same_folder(afm_rl, ran, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for extra in (["hydra/launcher=local"], ["figures=false"]):
        assert afm_rl(*SWEEP, *extra).status == 0
    assert len(ran.jobs) == 2
    (folder,) = (tmp_path / "multirun").iterdir()
    assert folder.name.startswith("planner.horizon-")
    assert afm_rl(*SWEEP, "budget=3").status == 0
    assert len(list((tmp_path / "multirun").iterdir())) == 2


def test_folders_of_sweeps_are_named_after_what_is_swept():
    named = with_sweep_folder(["-m", "+a/b=1,2", "tracks=[x,y]", "seeds=range(3)"])[-1]
    assert named.startswith("hydra.sweep.dir=multirun/a_b-seeds-")
    assert len(with_sweep_folder(["-m", "x" * 200 + "=1,2"])[-1]) < 90
    assert with_sweep_folder(["a=1,2", "-m"])[::2] == ["a=1,2", "-m"]  # Hydra wants them together


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (["hydra.launcher.n_jobs=some"], "hydra.launcher.n_jobs='some': expected"),
        (["hydra/launcher=nope"], "launcher/nope"),
        (["launcher=local"], "launcher is now called hydra/launcher"),
    ],
)
def test_launchers_that_cannot_be_used(sweep, settings, named):
    done = sweep(*SWEEP, *settings)
    assert (done.status, done.out) == (2, "")
    assert named in done.err and done.err.count("\n") == 1


def test_hydra_s_basic_launcher_runs_jobs_in_this_process(afm_rl, tmp_path, quick):
    """One that fails does not stop the others."""
    own = ["hydra/launcher=basic", f"hydra.sweep.dir={tmp_path}", *quick]
    done = afm_rl("-m", "method=physics", "budget=2", "seeds=0,1", *own)
    assert done.status == 2
    assert "afm-rl: seeds=0: expected a count" in done.err and "Traceback" not in done.err
    assert (tmp_path / "1" / "missions.csv").is_file()


def test_hydra_s_joblib_launcher_runs_jobs_in_its_workers(tmp_path, quick):
    """In processes of their own, which trust what the command trusts and nothing else."""
    code = "from afm_rl.planning import GoalDistance\nclass Far(GoalDistance): ...\n"
    (tmp_path / "mine.py").write_text(code)
    program = str(Path(sys.executable).with_name("afm-rl"))
    command = [program, "-m", "method=physics", "budget=2,3", "hydra/launcher=joblib", *quick]
    command += ["hydra.launcher.n_jobs=2", "hydra.sweep.dir=sweep", "cost._target_=mine.Far"]
    refused = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert refused.returncode == 2 and "only parts of afm_rl" in refused.stderr
    trusted = subprocess.run([*command, "trust=[mine]"], capture_output=True, cwd=tmp_path)
    assert trusted.returncode == 0, trusted.stderr
    runs = [pd.read_csv(tmp_path / "sweep" / name / "missions.csv") for name in ("0", "1")]
    assert [int(run["steps"].item()) for run in runs] == [1, 2]


def test_a_sweep_that_optimises_is_told_the_first_measure(sweep, quick, tmp_path):
    """It asks for trials a few at a time, each named after what is tuned; one report at the end."""
    few = ["hydra.sweeper.n_trials=3", "hydra.sweeper.n_jobs=2", "budget=15"]
    done = sweep("-m", "method=physics", "tune=temperature", *few, *quick)
    assert done.status == 0, done.err
    missions = pd.read_csv(tmp_path / "sweep" / "missions.csv")
    temperatures = missions["method"].str.extract(r"physics\+planner.temperature=(.*)")[0]
    assert temperatures.astype(float).between(1e-4, 10).all() and temperatures.nunique() == 3
    best = yaml.safe_load((tmp_path / "sweep" / "optimization_results.yaml").read_text())
    assert math.isclose(best["best_value"], missions["success_rate"].max(), rel_tol=1e-6)
    assert done.out.count("Results: ") == 1
    wrong = sweep("-m", "method=physics", "tune=temperature", *few, *quick, WORSE)
    assert wrong.status == 2 and "a higher success_rate is better; give" in wrong.err
    again = sweep("-m", "method=physics", "tune=temperature", *few, *quick)
    assert "2 of 2 jobs have results already" in again.out
