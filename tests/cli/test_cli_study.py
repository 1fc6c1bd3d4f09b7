"""Studies and comparisons from the command line."""

import pandas as pd
import pytest

from afm_rl.cli.overrides import relaxed


@pytest.fixture
def asked(monkeypatch):
    """Catch the jobs that a command would run."""
    calls = []
    monkeypatch.setattr(
        "afm_rl.cli.launch.run_batch", lambda *args, **how: calls.append((*args, how)) or {}
    )
    monkeypatch.setattr("afm_rl.cli.launch.report", lambda *args: 0.0)
    return calls


def methods(jobs):
    return {cfg.label: cfg for cfg in jobs.values()}


@pytest.mark.parametrize(
    ("study", "more", "budget", "count", "last"),
    [
        ("ugv", [], 5000, 13, "oracle"),
        ("ugv_families", ["compare=[physics,oracle]"], 3000, 2, "oracle"),
    ],
)
def test_the_studies(afm_rl, asked, study, more, budget, count, last, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    done = afm_rl(f"study={study}", *more, "planner.candidates=77")
    assert done.status == 0, done.err
    ((folder, jobs, _, how),) = asked
    assert folder == tmp_path / "outputs" / "study" / study
    assert how["progress"] is True and how["command"].startswith(f"afm-rl study={study} ")
    assert len(jobs) == 5 * count and [*jobs][0] == "physics+seed=0"
    assert [*jobs][-1] == f"{last}+seed=4"
    for name, cfg in jobs.items():
        assert name == f"{cfg.label}+seed={cfg.seeds[0]}"
        assert (len(cfg.seeds), cfg.budget, cfg.tracks) == (1, budget, "all")
        assert cfg.planner.candidates == 77
        assert "study" not in cfg and cfg.compare == []


def test_settings_of_some_methods(afm_rl, asked, tmp_path):
    folder = f"hydra.run.dir={tmp_path}"
    some = ["compare=[physics,online_pe,afm_online_pe]", "corrector.memory=90"]
    done = afm_rl("study=ugv", *some, "dynamics.propagation=sample", "seeds=1", folder)
    assert set(done.out.splitlines()[:3]) == {
        "physics: has no dynamics.propagation, so this setting does not change it",
        "physics: has no corrector.memory, so this setting does not change it",
        "online_pe: has no corrector.memory, so this setting does not change it",
    }
    ((_, jobs, *_),) = asked
    found = methods(jobs)
    assert "propagation" not in found["physics"].dynamics
    assert found["online_pe"].dynamics.propagation == "sample"
    assert found["afm_online_pe"].dynamics.propagation == "sample"
    assert list(found) == ["physics", "online_pe", "afm_online_pe"]


@pytest.mark.parametrize(
    ("chosen", "labels"),
    [
        (["study=ugv_paper", "compare=[online_pe,physics]"], ["online_pe", "physics"]),
        (["agent=paper", "compare=[physics,frozen_pe]"], ["physics", "frozen_pe"]),
        (["study=ugv_paper", "method=frozen_pe"], ["frozen_pe"]),
    ],
)
def test_an_agent_states_what_its_methods_are(afm_rl, asked, tmp_path, monkeypatch, chosen, labels):
    monkeypatch.setattr("afm_rl.cli.launch.report", lambda *args: None)
    settings = ["dynamics.pretrain.batch_size=128", "seeds=1"]
    assert afm_rl(*chosen, *settings, f"hydra.run.dir={tmp_path}").status == 0
    found = methods(asked[0][1])
    assert list(found) == labels
    for label, cfg in found.items():
        assert cfg.cost.coordinates == [0, 1, 2] and cfg.planner.noise == "unit"
        pe = label != "physics"
        assert (cfg.dynamics.get("propagation") == "sample") is pe
        assert not pe or cfg.dynamics.pretrain.batch_size == 128  # the command line counts most


def test_other_command_lines_stay_as_they_are():
    study = "study=ugv +dynamics.x=1 planner.x=1 dynamics=pe"
    for line in (study, "agent=paper dynamics.x=1", "dynamics=pe dynamics.x=1", "--help"):
        assert relaxed(line.split()) == line.split()


def test_a_study_of_one_method(afm_rl, asked, tmp_path):
    chosen = ["study=ugv", "method=oracle", "label=mine", "hydra.launcher.n_jobs=1"]
    assert afm_rl(*chosen, f"hydra.run.dir={tmp_path}").status == 0
    ((_, jobs, pool, _),) = asked
    assert (list(methods(jobs)), pool.size) == (["mine"], 1)


def test_a_small_study_and_its_report(afm_rl, tmp_path, quick):
    few = ["compare=[physics,oracle]", "tracks=ethz_1", "seeds=1", "budget=4", "regimes=none"]
    done = afm_rl("study=ugv", *few, *quick, f"hydra.run.dir={tmp_path}")
    assert done.status == 0, done.err
    assert pd.read_csv(tmp_path / "missions.csv")["method"].tolist() == ["physics", "oracle"]
    assert (tmp_path / "report" / "index.html").is_file()
