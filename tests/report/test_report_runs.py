"""Folders of runs, comparisons, sweeps and studies, read and joined."""

import shutil
from functools import partial
from itertools import product

import pandas as pd
import pytest
import yaml
from harness import refused

from afm_rl.cli import report
from afm_rl.errors import AFMError, ArtefactError, ConfigurationError
from afm_rl.report import read_runs
from afm_rl.storage.files import read_settings
from afm_rl.storage.manifest import write_manifest


@pytest.fixture
def study_folder(tmp_path, run_folder):
    """Write the folder of a study: a job per method and seed."""

    def write(name="study", methods=("physics", "oracle"), seeds=2, planned=(), regime=False):
        jobs, named = [], {"regime": ["v_gain = -1", "v_gain = 2"]} if regime else {}
        for method, seed in product((*methods, *planned), range(seeds)):
            jobs.append(f"{method}+seed={seed}")
            job = f"{name}/jobs/{jobs[-1]}"
            settings = yaml.safe_dump({"label": method, "seeds": [seed]})
            if method in planned:
                (tmp_path / job / "unfinished").mkdir(parents=True)
                (tmp_path / job / "unfinished" / "config.yaml").write_text(settings)
                continue
            change = partial(pd.DataFrame.assign, seed=seed, **named)
            folder = run_folder(job, change, methods=[method], v_gains=[-1.0, 2.0])
            (folder / "config.yaml").write_text(settings)
            spent = {"method": [method], "missions": 2, "seconds": 1800.0 * (1 + seed)}
            pd.DataFrame(spent).to_csv(folder / "compute.csv", index=False)
            write_manifest(folder)
        folder = tmp_path / name
        (folder / "jobs.yaml").write_text(yaml.safe_dump({"jobs": jobs}))
        done = [pd.read_csv(path) for path in sorted(folder.glob("jobs/*/missions.csv"))]
        whole = pd.concat(done) if done else pd.DataFrame(columns=["method", "seed"])
        whole.to_csv(folder / "missions.csv", index=False)
        (folder / "compute.csv").write_text("method,missions,seconds\n")
        write_manifest(folder, ["jobs.yaml", "missions.csv", "compute.csv"])
        return folder

    return write


def test_a_run_is_read_with_its_steps(run_folder, make_results, laps):
    found = read_runs([run_folder(seeds=2)])
    assert found.methods == ["physics", "adaptive", "oracle"] and found.measures == laps
    assert found.missions["mission"].tolist() == list(range(6))
    assert found.missions["scenario"].unique().tolist() == ["ring, v_gain = -1"]
    assert found.notes == found.lost == []
    _, steps = make_results(seeds=2)
    oracle = found.missions[found.missions["method"] == "oracle"]
    read = found.steps(oracle, ["error", "reached", "mass"])
    expected = steps[steps["mission"].isin([4, 5])].reset_index(drop=True)
    assert read["error"].tolist() == expected["error"].tolist()
    assert read["mass"].isna().all()
    assert set(steps) == set(found.steps(oracle))


def test_a_study_s_missions_stand_in_its_jobs(study_folder, make_results):
    found = read_runs([study_folder()])
    assert len(found.files) == 4 and len(found.missions) == 8
    assert found.methods == ["physics", "oracle"]
    oracle = found.missions[found.missions["method"] == "oracle"]
    assert oracle["own"].tolist() == [0, 0, 1, 1]  # scenario by scenario
    assert oracle["seed"].tolist() == [0, 1, 0, 1]
    read = found.steps(oracle, ["error"])
    _, steps = make_results(["oracle"], v_gains=[-1.0, 2.0])
    for row in oracle.itertuples():
        own = read.loc[read["mission"] == row.mission, "error"]
        assert own.tolist() == steps.loc[steps["mission"] == row.own, "error"].tolist()
    assert oracle["seconds"].tolist() == [900.0, 1800.0] * 2  # of a job, in equal shares


def test_methods_have_the_order_of_the_record_and_without_one_jobs_may_be_missing(study_folder):
    folder = study_folder(methods=("physics", "adaptive"))
    assert read_runs([folder]).methods == ["physics", "adaptive"]
    (folder / "jobs.yaml").unlink()
    (folder / "manifest.json").unlink()
    found = read_runs([folder])
    assert found.methods == ["adaptive", "physics"]
    assert found.notes == [f"{folder} has no manifest.json: missing jobs cannot be detected."]


def test_the_later_folder_wins_and_says_so(run_folder, study_folder):
    change = partial(pd.DataFrame.assign, steps=7)
    first = run_folder("first", change, methods=["oracle"], v_gains=[-1.0, 0.5], seeds=2)
    found = read_runs([first, study_folder(regime=True)])
    oracle = found.missions[found.missions["method"] == "oracle"]
    assert len(oracle) == 6  # -1 and 2 of the study, 0.5 of the run
    assert oracle.loc[oracle["v_gain"] == 0.5, "steps"].eq(7).all()
    assert oracle.loc[oracle["v_gain"] == -1.0, "steps"].gt(7).all()
    (note,) = found.notes
    assert note.startswith(f"oracle: 2 missions of {first} are there twice")


def test_what_has_not_begun_is_said(study_folder):
    found = read_runs([study_folder(planned=["online_pe"])])
    assert found.missing.empty
    expected = [f"online_pe+seed={seed} has no results yet." for seed in (0, 1)]
    assert [note.rpartition("/")[2] for note in found.notes] == expected


def test_a_study_that_has_just_begun_joins_others(run_folder, study_folder):
    new = study_folder("new", methods=(), planned=["a"])
    with pytest.raises(ConfigurationError, match="no mission is finished yet"):
        read_runs([new])
    assert len(read_runs([new, run_folder()]).missions) == 3


def test_names_that_look_like_numbers_stay_text(run_folder):
    change = partial(pd.DataFrame.assign, method=10, track=1)
    found = read_runs([run_folder(change=change, methods=["oracle"])])
    assert found.methods == ["10"]
    assert found.missions["scenario"].tolist() == ["1, v_gain = -1"]


def rewrite(folder, name, content):
    """Change a file as somebody would who also renews the manifest."""
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    write_manifest(folder)


BOMB = "a: &a [x, x]\nb: &b [*a, *a]\nseeds: [*b, *b]\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missions.csv", "method,track\n", "columns seed, .* are missing"),
        ("missions.csv", "", "no table of values"),
        ("missions.csv", b"\xff\xfe\x00", "no UTF-8 text"),
        ("compute.csv", "method\na\n", "columns seconds, missions are missing"),
        ("compute.csv", "method,seconds,missions\na,soon,1\n", "seconds: expected a finite"),
        ("measures.json", "{", "no declaration of measures"),
        ("measures.json", b"\xff", "no UTF-8 text"),
        ("jobs.yaml", "a: [", "damaged"),
        ("jobs.yaml", BOMB, r"damaged; delete it: aliases \(\*name\) are not read"),
        ("jobs.yaml", "a: " + "[" * 5000, "damaged; delete it: more than 50 levels"),
        ("jobs.yaml", "a: !!python/object/apply:os.getcwd []\n", "damaged"),
        ("jobs.yaml", "x" * (5 * 2**20), "5242880 bytes; expected 4194304 at most"),
        ("steps.parquet", "no", "damaged, or no Parquet file"),
    ],
)
def test_files_that_cannot_be_used_are_named(run_folder, name, content, message):
    folder = run_folder()
    rewrite(folder, name, content)
    with pytest.raises(AFMError, match=f"{name}: {message}") as caught:
        found = read_runs([folder])
        found.steps(found.missions, ["error"])
    assert "\n" not in str(caught.value)


def test_nothing_is_interpolated(run_folder, monkeypatch):
    monkeypatch.setenv("SECRET", "hush")
    folder = run_folder()
    rewrite(folder, "config.yaml", "label: ${oc.env:SECRET}\nseeds: [0]\n")
    assert read_settings(folder / "config.yaml")["label"] == "${oc.env:SECRET}"


RUN = ["missions.csv", "steps.parquet", "measures.json", "config.yaml"]
BESIDE_JOBS = ["jobs.yaml", "missions.csv", "compute.csv", "manifest.json"]


@pytest.mark.parametrize("name", [*RUN, *(f"study/{name}" for name in BESIDE_JOBS)])
def test_a_damaged_file_is_named(run_folder, study_folder, name):
    study, _, name = name.rpartition("/")
    folder = study_folder(seeds=1) if study else run_folder()
    if not study:
        rewrite(folder, "config.yaml", "label: physics\nseeds: [0]\n")
    whole = (folder / name).read_bytes()
    for place in range(0, len(whole), max(1, len(whole) // 12)):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << place % 8
        (folder / name).write_bytes(spoilt)
        with pytest.raises(ArtefactError, match=f"{name}: damaged"):
            read_runs([folder])


def test_a_job_that_was_deleted_is_missed(study_folder, called):
    folder = study_folder()
    job = folder / "jobs" / "oracle+seed=0"
    shutil.rmtree(job)
    found = read_runs([folder])
    (lost,) = found.lost
    assert lost.startswith(f"{job}: missing, although jobs.yaml names it")
    scenarios = [f"ring, v_gain = {gain}" for gain in (-1, 2)]
    assert found.missing.to_numpy().tolist() == [["oracle", scenario, 0] for scenario in scenarios]
    said = called(report.main, "afm-rl-report", folder, "--no-figures")
    assert said.status == 2 and said.err == f"afm-rl-report: {lost}\n"
    assert "; 2 missions are missing." in said.out and lost in said.out
    assert str(job) in (folder / "report" / "index.html").read_text()


@refused(
    ("steps", "many", "steps: expected a finite number"),
    ("steps", "1e999", "steps: expected a finite number"),
    ("steps", "1.5", "steps: expected a whole number"),
    ("mission", "0", "mission: expected another number"),
    ("finished", "maybe", "finished: expected True or False"),
    ("method", "", "method: expected a text"),
    ("method", "m" * 501, "method: expected a text of 1 to 500 letters"),
    says="missions.csv: {}",
)
def test_values_that_cannot_be_are_refused(column, value, run_folder):
    folder = run_folder()
    table = pd.read_csv(folder / "missions.csv", dtype=str)
    rewrite(folder, "missions.csv", table.assign(**{column: value}).to_csv(index=False))
    read_runs([folder])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda steps: steps.assign(error="high"),
        lambda steps: steps.assign(t=None),
        lambda steps: steps.drop(columns="t"),
    ],
)
def test_steps_that_are_no_numbers_are_refused(run_folder, spoil):
    folder = run_folder()
    spoil(pd.read_parquet(folder / "steps.parquet")).to_parquet(folder / "steps.parquet")
    write_manifest(folder)
    found = read_runs([folder])
    with pytest.raises(ConfigurationError, match=r"steps\.parquet: .*expected"):
        found.steps(found.missions, ["error"])


@refused(
    ([], "at least one folder"),
    (["nowhere"], "nowhere: no such folder; expected the folder"),
    ([""], "holds no missions.csv"),
    (["run"], "holds no missions.csv"),
)
def test_folders_without_results_are_refused(folders, tmp_path):
    (tmp_path / "run" / "missions.csv").mkdir(parents=True)
    read_runs([tmp_path / name for name in folders])


def test_short_names_leave_out_gains_of_one(run_folder):
    found = read_runs([run_folder(methods=["oracle"], v_gains=[-1.0, 1.0, 1.5, 0.1])])
    names = ["v_gain = -1", "nominal", "v_gain = 1.5", "v_gain = 0.1"]
    assert found.missions["scenario"].tolist() == [f"ring, {name}" for name in names]


def test_a_name_that_is_a_formula_reads_back_as_it_was(run_folder):
    name = "=cmd|' /C calc'!A0"
    folder = run_folder(change=lambda missions: missions.assign(method=name), methods=["oracle"])
    assert pd.read_csv(folder / "missions.csv")["method"].tolist() == ["'" + name]
    assert read_runs([folder]).methods == [name]
