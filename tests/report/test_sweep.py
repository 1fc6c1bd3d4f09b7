"""Sweeps in reports."""

import pandas as pd
import pytest
import yaml

from afm_rl.errors import ConfigurationError
from afm_rl.report.collect import collect
from afm_rl.report.sweep import sources


@pytest.fixture
def add_job(tmp_path):
    """Write a job of a sweep, and a mission if it has results."""

    def add(number, overrides, method="physics", seed=0):
        folder = tmp_path / "sweep" / str(number)
        folder.mkdir(parents=True)
        (folder / "job.yaml").write_text(yaml.safe_dump({"overrides": overrides}))
        if method:
            row = {"method": method, "track": "oval", "v_gain": -1.0, "seed": seed}
            row |= {"success_rate": 1.0, "steps": 9, "reached": 1, "targets": 1, "finished": True}
            pd.DataFrame([row | {"mission": 0}]).to_csv(folder / "missions.csv", index=False)
        return tmp_path / "sweep"

    return add


def test_methods_are_named_after_what_is_swept(add_job):
    common = ["budget=9", "method=physics"]
    for number, horizon in enumerate(range(9, 20)):
        sweep = add_job(number, [f"planner.horizon={horizon}", *common])
    found = collect([sweep])
    assert found.methods == [f"physics+planner.horizon={horizon}" for horizon in range(9, 20)]
    assert found.notes[:-1] == []  # the last one misses the steps


def test_what_the_tables_tell_is_not_told_twice(add_job):
    add_job(0, ["method=physics", "seeds=[0]"])
    add_job(1, ["method=physics", "seeds=[1]"], seed=1)
    add_job(2, ["method=oracle", "seeds=[0]"], method="oracle")
    sweep = add_job(3, ["corrector=afm", "seeds=[0]"], method="physics+corrector=afm")
    assert collect([sweep]).methods == ["physics", "oracle", "physics+corrector=afm"]


def test_a_label_for_all_does_not_hide_what_is_swept(add_job):
    add_job(0, ["corrector=afm", "label=mine"], method="mine")
    sweep = add_job(1, ["corrector=paper", "label=mine"], method="mine")
    assert collect([sweep]).methods == ["mine+corrector=afm", "mine+corrector=paper"]


def test_jobs_without_results_are_said(add_job):
    add_job(0, ["budget=1"])
    sweep = add_job(1, ["budget=2"], method=None)
    parts, notes = sources([sweep, sweep / "0"])
    assert [part.folder.name for part in parts] == ["0", "0"]
    assert notes == [f"{sweep}/1 has no results: budget=2."]


def test_a_sweep_without_results_is_refused(add_job):
    sweep = add_job(0, ["budget=1"], method=None)
    with pytest.raises(ConfigurationError, match="sweep: no job of this sweep has results yet"):
        collect([sweep])


@pytest.mark.parametrize("text", ["- 1\n", "overrides: 3\n", "a: [\n", "overrides\n"])
def test_damaged_notes_of_a_job_are_named(add_job, text):
    sweep = add_job(0, [])
    (sweep / "0" / "job.yaml").write_text(text)
    with pytest.raises(ConfigurationError, match=r"0/job\.yaml: damaged"):
        sources([sweep])
