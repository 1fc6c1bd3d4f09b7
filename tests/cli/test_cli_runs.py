"""What a run of the command line leaves behind."""

from unittest.mock import Mock

import pandas as pd
import pytest
from harness import files_of
from omegaconf import OmegaConf

from afm_rl.missions import build, prepare, run
from afm_rl.report import read_runs


def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))


def test_one_method_whose_results_are_not_overwritten_unless_told(afm_rl, tmp_path, quick):
    folder = tmp_path / "new" / "run"
    command = ["method=physics", "budget=4", f"hydra.run.dir={folder}", *quick]
    done = afm_rl(*command, "seeds=2")
    assert (done.status, done.err) == (0, "")
    tables = ["compute.csv", "config.yaml", "manifest.json", "measures.json", "missions.csv"]
    assert files(folder) == [".lock", *tables, "steps.parquet"]
    missions = pd.read_csv(folder / "missions.csv")
    assert missions["method"].tolist() == ["physics"] * 2
    assert missions["v_gain"].eq(-1).all() and missions["steps"].eq(3).all()
    assert len(pd.read_parquet(folder / "steps.parquet")) == 8
    assert "physics" in done.out and "Actuators" not in done.out
    assert done.out.rstrip().endswith(f"Results: {folder}")
    before, refused = files_of(folder), afm_rl(*command, "planner.candidates=17")
    assert refused.status == 2 and files_of(folder) == before
    assert refused.err == (
        f"afm-rl: {folder}/config.yaml: belongs to other settings (planner.candidates: 16 -> 17; "
        "seeds: 2 -> 1); choose another folder, or overwrite=true\n"
    )
    assert "has these results already" in afm_rl(*command, "seeds=2").out
    assert afm_rl(*command, "overwrite=true").status == 0
    assert len(pd.read_csv(folder / "missions.csv")) == 1


@pytest.mark.slow
def test_bare_compares_four_methods(afm_rl, tmp_path, short_trainings, quick):
    few = [f"cache={tmp_path}/parts", "budget=24", "planner.candidates=8", "regimes=slip"]
    few += ["diagnosis=true"]
    done = afm_rl(f"hydra.run.dir={tmp_path}", *few)
    assert done.status == 0
    methods = ["physics", "online_pe", "afm_physics", "oracle"]
    missions = pd.read_csv(tmp_path / "missions.csv")
    assert missions["method"].tolist() == methods
    assert missions["mission"].tolist() == [0, 1, 2, 3]
    assert missions["track"].eq("ethz_2").all()
    assert read_runs([tmp_path]).steps()["mission"].tolist() == sorted(24 * [*range(4)])
    assert sorted(path.name for path in (tmp_path / "jobs").iterdir()) == sorted(methods)
    assert (tmp_path / "figures" / "trajectory.png").stat().st_size > 1000
    shown = sorted(path.name for path in (tmp_path / "tensorboard").iterdir())
    assert shown == sorted(methods)
    said = "".join(path.read_text() for path in tmp_path.glob("jobs/*/log.txt"))
    assert "ensemble: held-out error" in said
    assert all(method in done.out for method in methods)
    # What a planner without correction runs into under slip shows little of the actuators.
    which, *said = done.out.partition("Actuators, by the steps of ")[2].splitlines()
    assert which == "afm_physics, ethz_2, seed 0:"
    assert [line.partition(":")[0] for line in said[:-1]] == ["v", "omega"]
    alone = ["compare=[physics, oracle]", f"hydra.run.dir={tmp_path}/alone", *quick]
    assert "No diagnosis: none of these methods corrects" in afm_rl(*few, *alone).out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choices", "labels"),
    [
        (["method=physics"], ["physics"]),
        (["method=physics", "label=mine"], ["mine"]),
        (["method=oracle", "dynamics=oracle"], ["oracle+dynamics=oracle"]),
        (["compare=[]"], ["physics"]),
        (["dynamics=oracle", "updater=oracle"], ["dynamics=oracle+updater=oracle"]),
        (["compare=[physics]", "corrector=none"], ["physics+corrector=none"]),
        (["compare=[oracle, physics]", "label=mine"], ["oracle", "physics"]),
    ],
)
def test_labels_tell_what_was_chosen(afm_rl, tmp_path, quick, choices, labels):
    assert afm_rl(*choices, "budget=1", f"hydra.run.dir={tmp_path}", *quick).status == 0
    assert pd.read_csv(tmp_path / "missions.csv")["method"].tolist() == labels


def test_a_run_is_built_once_and_diagnosed_if_it_is_asked_for(afm_rl, tmp_path, quick, monkeypatch):
    counted = Mock(wraps=build)
    for module in ("missions", "jobs.run"):
        monkeypatch.setattr(f"afm_rl.{module}.build", counted)
    command = ["method=afm_physics", "budget=30", "diagnosis=true", *quick]
    done = afm_rl(*command, f"hydra.run.dir={tmp_path}")
    assert done.status == 0 and (tmp_path / "diagnosis").exists()
    assert "Actuators, by the steps of afm_physics" in done.out
    assert counted.call_count == 1


def stored(folder):
    return pd.read_csv(folder / "missions.csv"), read_runs([folder]).steps()


def test_the_stored_configuration_makes_the_same_run(afm_rl, tmp_path, quick, cache):
    first, again = tmp_path / "first", tmp_path / "again"
    train = ["corrector.width=8", "corrector.train.iterations=5", "corrector.train.batch_size=16"]
    parts = ["corrector=paper", *train]
    chosen = [*parts, "budget=8", "seeds=[4]", "label=mine"]
    assert afm_rl(*chosen, *quick, f"hydra.run.dir={first}").status == 0
    replay = [f"--config-path={first}", "--config-name=config", f"hydra.run.dir={again}"]
    done = afm_rl(*replay)
    assert done.status == 0
    assert "from the cache" in done.out
    for one, other in zip(stored(first), stored(again), strict=True):
        pd.testing.assert_frame_equal(one, other, check_exact=True)
    agent = build(OmegaConf.load(first / "config.yaml"))  # and so it does in Python
    prepare(agent, cache)
    pd.testing.assert_frame_equal(run(agent).steps, stored(first)[1], check_exact=True)


def test_a_bug_is_not_dressed_up_as_a_mistake(afm_rl, tmp_path, quick, monkeypatch):
    def bug(*args, **kwargs):
        raise RuntimeError("a bug")

    monkeypatch.setattr("afm_rl.jobs.run.run", bug)
    with pytest.raises(RuntimeError, match="a bug"):
        afm_rl("method=physics", f"hydra.run.dir={tmp_path}", *quick)


def test_help_of_a_choice_says_what_its_settings_are_for(afm_rl):
    done = afm_rl("--help", "planner=icem")
    assert done.status == 0 and "_target_: afm_rl.planning.ICEM" in done.out
    assert "beta: 1.0 # exponent of the spectrum, [0, 100]; 0: white, 2: red" in done.out
