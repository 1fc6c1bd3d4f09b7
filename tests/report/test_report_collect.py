"""Folders of runs and studies, read and joined."""

import pandas as pd
import pytest

from afm_rl.errors import ConfigurationError
from afm_rl.report import write_run
from afm_rl.report.collect import collect
from afm_rl.report.results_files import read_steps, read_table


@pytest.fixture
def run_folder(tmp_path, make_results):
    """Write the folder of a run."""

    def write(name="run", **chosen):
        missions, steps = make_results(**chosen)
        quiet = {"figures": False, "tensorboard": False, "echo": lambda line: None}
        write_run(tmp_path / name, missions, steps, **quiet)
        return tmp_path / name

    return write


@pytest.fixture
def study_folder(tmp_path, make_results):
    """Write the folder of a study: shards, and the tables made of them."""

    def write(name="study", methods=("physics", "oracle"), seeds=2, asked=None, regime=False):
        folder = tmp_path / name
        tables = []
        for method in methods:
            missions, steps = make_results([method], v_gains=[-1.0, 2.0], seeds=seeds)
            if regime:
                missions["regime"] = missions["v_gain"].map("v_gain = {:g}".format)
            for seed, own in missions.groupby("seed"):
                shard = folder / "shards" / method / str(seed)
                shard.mkdir(parents=True)
                number = {mission: place for place, mission in enumerate(own["mission"])}
                rows = steps[steps["mission"].isin(number)]
                own = own.assign(mission=range(len(own)))
                own.to_csv(shard / "missions.csv", index=False)
                rows.assign(mission=rows["mission"].map(number)).to_parquet(shard / "steps.parquet")
                tables.append(own)
        table = pd.concat(tables).drop(columns="seconds")
        table.assign(mission=range(len(table))).to_csv(folder / "missions.csv", index=False)
        names = "".join(f"  {method}: {{budget: 400}}\n" for method in asked or methods)
        text = f"version: 0.1.0\nseeds: [{', '.join(map(str, range(seeds)))}]\nmethods:\n{names}"
        (folder / "study.yaml").write_text(text)
        compute = {"method": methods, "missions": 4, "seconds": [7200.0, 3600.0][: len(methods)]}
        pd.DataFrame(compute).to_csv(folder / "compute.csv", index=False)
        return folder

    return write


def test_a_run_is_read_with_its_steps(run_folder, make_results):
    found = collect([run_folder(seeds=2)])
    assert found.methods == ["physics", "adaptive", "oracle"]
    assert found.missions["mission"].tolist() == list(range(6))
    assert found.missions["cell"].unique().tolist() == ["ring, v_gain = -1"]
    assert found.notes == [] and found.asked.empty and found.compute.empty
    _, steps = make_results(seeds=2)
    oracle = found.missions[found.missions["method"] == "oracle"]
    read = read_steps(found.files, oracle, ["error", "reached", "mass"])
    expected = steps[steps["mission"].isin([4, 5])].reset_index(drop=True)
    assert read["error"].tolist() == expected["error"].tolist()
    assert read["mass"].isna().all()


def test_a_study_s_steps_stand_in_its_shards(study_folder, make_results):
    found = collect([study_folder()])
    assert len(found.files) == 4
    oracle = found.missions[found.missions["method"] == "oracle"]
    assert oracle["own"].tolist() == [0, 1, 0, 1]  # seed 0, then seed 1
    read = read_steps(found.files, oracle, ["error"])
    _, steps = make_results(["oracle"], v_gains=[-1.0, 2.0], seeds=2)
    for row in oracle.itertuples():
        place = 2 * (row.v_gain == 2.0) + row.seed
        own = read.loc[read["mission"] == row.mission, "error"]
        assert own.tolist() == steps.loc[steps["mission"] == place, "error"].tolist()
    assert found.compute.loc["oracle"].to_dict() == {"seconds": 3600.0, "missions": 4}


def test_methods_have_the_order_of_the_study_s_table(study_folder):
    assert collect([study_folder(methods=("physics", "adaptive"))]).methods == [
        "physics",
        "adaptive",
    ]


def test_shards_count_that_the_table_does_not_have_yet(study_folder):
    folder = study_folder()
    table = pd.read_csv(folder / "missions.csv")
    table[table["method"] == "physics"].to_csv(folder / "missions.csv", index=False)
    assert len(collect([folder]).missions) == 8
    (folder / "missions.csv").unlink()
    assert len(collect([folder]).missions) == 8


def test_a_study_without_its_shards_has_no_steps(study_folder):
    folder = study_folder()
    for path in folder.glob("shards/*/*/*"):
        path.unlink()
    found = collect([folder])
    assert len(found.missions) == 8
    (note,) = found.notes
    assert note.startswith("8 of 8 missions have no steps.parquet")
    assert read_steps(found.files, found.missions, ["error"]).empty


def test_the_later_folder_wins_and_says_so(run_folder, study_folder):
    first = run_folder("first", methods=["oracle"], v_gains=[-1.0, 0.5], seeds=2)
    table = pd.read_csv(first / "missions.csv")
    table.assign(steps=7).to_csv(first / "missions.csv", index=False)
    found = collect([first, study_folder(regime=True)])
    oracle = found.missions[found.missions["method"] == "oracle"]
    assert len(oracle) == 6  # -1 and 2 of the study, 0.5 of the run
    assert oracle.loc[oracle["v_gain"] == 0.5, "steps"].eq(7).all()
    assert oracle.loc[oracle["v_gain"] == -1.0, "steps"].gt(7).all()
    (note,) = found.notes
    assert note.startswith(f"oracle: 2 missions of {first} stand twice")


def test_what_a_study_asked_for_is_known(study_folder):
    asked = collect([study_folder(asked=["physics", "oracle", "online_pe"])]).asked
    assert len(asked) == 3 * 2 * 2
    assert set(asked["method"]) == {"physics", "oracle", "online_pe"}


def test_seeds_may_be_a_count_and_cells_a_list(study_folder):
    folder = study_folder()
    text = "methods: [a]\nseeds: 3\ncells: ['ring, slip']\n"
    (folder / "study.yaml").write_text(text)
    asked = collect([folder]).asked
    assert asked.to_numpy().tolist() == [["a", "ring, slip", seed] for seed in range(3)]


def test_a_study_that_has_just_begun_joins_others(run_folder, tmp_path):
    new = tmp_path / "new"
    new.mkdir()
    (new / "study.yaml").write_text("methods: {a: {}}\nseeds: [0]\n")
    with pytest.raises(ConfigurationError, match="no mission is finished yet"):
        collect([new])
    assert len(collect([new, run_folder()]).missions) == 3


def test_names_that_look_like_numbers_stay_text(run_folder):
    folder = run_folder(methods=["oracle"])
    table = pd.read_csv(folder / "missions.csv")
    table.assign(method=10, track=1).to_csv(folder / "missions.csv", index=False)
    found = collect([folder])
    assert found.methods == ["10"]
    assert found.missions["cell"].tolist() == ["1, v_gain = -1"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missions.csv", "method,track\n", "columns seed, success_rate.* are missing"),
        ("missions.csv", "", "no table of values"),
        ("missions.csv", b"\xff\xfe\x00", "no table of values"),
        ("compute.csv", "method\na\n", "columns seconds, missions are missing"),
        ("study.yaml", "seeds: 3\n", "expected the entries methods and seeds"),
        ("study.yaml", "a: [", "cannot be read"),
        ("steps.parquet", "no", "damaged, or no Parquet file"),
    ],
)
def test_files_that_cannot_be_used_are_named(run_folder, name, content, message):
    folder = run_folder()
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ConfigurationError, match=f"{name}: {message}"):
        found = collect([folder])
        read_steps(found.files, found.missions, ["error"])


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("steps", "many", "steps: expected a finite number"),
        ("success_rate", "", "success_rate: expected a finite number"),
        ("finished", "maybe", "finished: expected True or False"),
    ],
)
def test_values_that_cannot_be_are_refused(run_folder, column, value, message):
    folder = run_folder()
    table = pd.read_csv(folder / "missions.csv")
    table.assign(**{column: value}).to_csv(folder / "missions.csv", index=False)
    with pytest.raises(ConfigurationError, match=message):
        collect([folder])


def test_a_table_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match="none.csv: No such file"):
        read_table(tmp_path / "none.csv", ["a"])


def test_folders_without_results_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="at least one folder"):
        collect([])
    with pytest.raises(ConfigurationError, match="nowhere: no such folder; expected the folder"):
        collect([tmp_path / "nowhere"])
    with pytest.raises(ConfigurationError, match="holds no missions.csv"):
        collect([tmp_path])
    (tmp_path / "missions.csv").mkdir()
    (tmp_path / "study.yaml").mkdir()
    with pytest.raises(ConfigurationError, match="holds no missions.csv"):
        collect([tmp_path])
