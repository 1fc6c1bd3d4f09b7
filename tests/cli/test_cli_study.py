"""Studies from the command line."""

import os
import signal
import subprocess
import sys
import time

import pandas as pd
import pytest
from omegaconf import OmegaConf

from afm_rl.cli.overrides import relaxed
from afm_rl.errors import ArtefactError
from afm_rl.missions import LapScore
from afm_rl.missions.shard import Shard
from afm_rl.missions.study import Outcome

TINY = ["study=ugv", "compare=[physics,oracle]", "tracks=ethz_1", "planner.population=16"]


@pytest.fixture
def asked(monkeypatch):
    """Catch what a study would be asked to do."""
    calls = []

    def run_study(folder, methods, workers, every, progress):
        calls.append((folder, {cfg.label: cfg for cfg in methods}, workers, every, progress))
        return Outcome(pd.DataFrame(), {})

    monkeypatch.setattr("afm_rl.cli.study.run_study", run_study)
    return calls


@pytest.mark.slow
def test_a_study_in_processes_of_its_own(process, program, tmp_path):
    """Interrupted once on the way, and taken up by the same program under its other name."""
    settings = ["compare=[physics]", "tracks=ethz_1", "regimes=[{v_gain: -1.0}]", "seeds=1"]
    settings += ["study=ugv", "study.workers=1", "study.every=0", "study.name=mine", "budget=200"]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([program, *settings], cwd=tmp_path, env=env, **silent) as running:
        folder = tmp_path / "outputs" / "study" / "mine"
        while not list(folder.glob("shards/*/*/checkpoint.safetensors")):
            assert running.poll() is None
            time.sleep(0.02)
        running.send_signal(signal.SIGINT)
        assert running.wait() == 130
    assert list(folder.glob("shards/physics/0/checkpoint.safetensors"))
    done = process(sys.executable, "-m", "afm_rl.cli", *settings)
    assert (done.returncode, done.stderr) == (0, "")
    assert "[1/1] physics, seed 0: 1 missions, 200 steps in" in done.stdout
    assert done.stdout.rstrip().endswith(f"Results: {folder}")
    assert len(pd.read_csv(folder / "missions.csv")) == 1
    assert list(folder.glob("shards/*/*/checkpoint.safetensors")) == []


@pytest.mark.parametrize(
    ("study", "budget", "count", "last"),
    [
        ("ugv", 5000, 13, "oracle"),
        ("ugv_paper", 5000, 5, "afm_paper"),
        ("ugv_families", 3000, 13, "oracle"),
    ],
)
def test_the_studies(afm_rl, asked, study, budget, count, last, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    done = afm_rl(f"study={study}", "planner.population=77")
    assert done.status == 0, done.err
    ((folder, methods, workers, every, progress),) = asked
    assert folder == tmp_path / "outputs" / "study" / study
    assert (workers, every, progress) == (None, 60, True)
    assert len(methods) == count and [*methods][0] == "physics" and [*methods][-1] == last
    for cfg in methods.values():
        assert (cfg.seeds, cfg.budget, cfg.tracks) == (5, budget, "all")
        assert cfg.planner.population == 77
        assert "study" not in cfg and cfg.compare == []


def test_settings_of_some_methods(afm_rl, asked, tmp_path):
    folder = f"hydra.run.dir={tmp_path}"
    some = ["compare=[physics,online_pe,afm_online_pe]", "corrector.checkpoint=null"]
    done = afm_rl("study=ugv", *some, "dynamics.propagation=sample", "seeds=1", folder)
    assert set(done.out.splitlines()[:3]) == {
        "physics: has no dynamics.propagation, so it stays as it is",
        "physics: has no flow.checkpoint, so it stays as it is",
        "online_pe: has no flow.checkpoint, so it stays as it is",
    }
    ((_, methods, *_),) = asked
    assert "propagation" not in methods["physics"].dynamics
    assert methods["online_pe"].dynamics.propagation == "sample"
    assert methods["afm_online_pe"].dynamics.propagation == "sample"
    assert list(methods) == ["physics", "online_pe", "afm_online_pe"]


@pytest.mark.parametrize("study", ["study=ugv", "compare=[physics,oracle]"])
def test_settings_that_no_method_has_are_refused(afm_rl, tmp_path, study):
    chosen = [study, "compare=[physics,oracle]"]
    done = afm_rl(*chosen, "dynamics.membrs=3", f"hydra.run.dir={tmp_path}")
    assert (done.status, done.out) == (2, "")
    assert done.err == ("afm-rl: dynamics.membrs=3: none of physics, oracle has dynamics.membrs\n")


def test_a_comparison_takes_settings_of_some_methods_too(afm_rl, tmp_path, quick):
    chosen = ["compare=[physics, adaptive_gain]", "corrector.window=7", "budget=2"]
    done = afm_rl(*chosen, *quick, f"hydra.run.dir={tmp_path}")
    assert done.status == 0, done.err
    assert "physics: has no corrector.window, so it stays as it is" in done.out
    assert OmegaConf.load(tmp_path / "config" / "adaptive_gain.yaml").corrector.window == 7


@pytest.mark.parametrize(
    "arguments",
    [
        ["method=physics", "dynamics.x=1"],
        ["dynamics=pe", "dynamics.x=1"],
        ["study=ugv", "+dynamics.x=1", "planner.x=1", "dynamics=pe"],
        ["--help"],
    ],
)
def test_other_command_lines_stay_as_they_are(arguments):
    assert relaxed(arguments) == arguments


def test_a_study_of_one_method(afm_rl, asked, tmp_path):
    chosen = ["study=ugv", "method=oracle", "study.workers=3", "label=mine"]
    assert afm_rl(*chosen, f"hydra.run.dir={tmp_path}").status == 0
    ((_, methods, workers, *_),) = asked
    assert (list(methods), workers) == (["mine"], 3)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (["study.workers=0"], "study.workers=0"),
        (["study.every=soon"], "study.every='soon'"),
        (["study.crew=1"], "study.crew"),
        (["study=nope"], "study/nope"),
        (["budget=0"], "budget=0"),
    ],
)
def test_mistakes_are_one_line(afm_rl, tmp_path, settings, named):
    done = afm_rl(*TINY, f"hydra.run.dir={tmp_path}/run", *settings)
    assert done.status == 2
    assert named in done.err and done.err.count("\n") == 1
    assert not any((tmp_path / "run").glob("*"))


def ended(monkeypatch, outcome):
    """Let a study end at once; return the folders that a report was asked for."""
    reported = []

    def run_study(*args):
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr("afm_rl.cli.study.run_study", run_study)
    monkeypatch.setattr(
        "afm_rl.cli.study.write_report", lambda folders, *_, **__: reported.extend(folders)
    )
    return reported


def test_shards_that_failed_are_listed(afm_rl, tmp_path, monkeypatch):
    row = {"method": "physics", "track": "oval", "seed": 0, "seconds": 2.0, "steps": 3}
    missions = pd.DataFrame([row | {"success_rate": 1.0, "finished": True, "targets": 1}])
    reported = ended(
        monkeypatch, Outcome(missions, {Shard("oracle", 3): "out of luck"}, LapScore.measures)
    )
    done = afm_rl(*TINY, f"hydra.run.dir={tmp_path}")
    assert done.status == 1
    assert reported == [tmp_path]
    assert "physics" in done.out and f"Results: {tmp_path}" in done.out
    assert "afm-rl: oracle, seed 3: failed: out of luck\n" in done.err
    assert "1 shards failed" in done.err


def test_an_interrupted_study_says_how_to_go_on(afm_rl, tmp_path, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    ended(monkeypatch, KeyboardInterrupt())
    done = afm_rl(*TINY, f"hydra.run.dir={tmp_path}")
    assert done.status == 130
    assert done.err == (
        f"afm-rl: interrupted; the same command goes on from here (hydra.run.dir={tmp_path})\n"
    )
    assert signal.getsignal(signal.SIGTERM) == before


def test_damaged_files_are_one_line(afm_rl, tmp_path, monkeypatch):
    ended(monkeypatch, ArtefactError("study.yaml: damaged"))
    done = afm_rl(*TINY, f"hydra.run.dir={tmp_path}")
    assert (done.status, done.err) == (2, "afm-rl: study.yaml: damaged\n")
