"""The examples run, by the line on top of each file, with less to do; deploy: test_deploy.py."""

import re
import runpy
import shlex
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).resolve().parents[1]
LESS = {
    "transform": "",
    "plan": "--steps 20",
    "learn": "--batches 2 --samples 512",
    "compare": "--methods physics oracle --budget 10",
    "policies": "--steps 40 --at 20",
}
OF_FILES = {  # where the examples of a folder differ
    "stable_baselines.py": "--steps 64 --episodes 1",
    "train_sac.py": "--id Pendulum-v1 --steps 60 --first 40 --out policy.safetensors",
}
TABLES = ROOT / "examples" / "policies" / "tables.py"  # reads results, see its own test
FILES = [path for verb in LESS for path in sorted((ROOT / "examples" / verb).glob("*.py"))]
FILES.remove(TABLES)


def lines_on_top(path):
    """Find the commands in a file's docstring."""
    return re.findall(r"(?:^ {4}|``)(python examples/\S+[^\n`]*)", path.read_text(), re.MULTILINE)


def test_every_example_says_how_to_run_it():
    found = [path for path in (ROOT / "examples").glob("*/*.py") if lines_on_top(path)]
    assert {path.parent.name for path in found} >= {*LESS, "deploy", "explain_afm"}
    for path in found:
        (line,) = lines_on_top(path)
        assert ROOT / shlex.split(line)[1] == path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_examples_run(path, short_trainings, monkeypatch, tmp_path, capsys):
    if path.parent.name == "policies":
        pytest.importorskip("mujoco")
    if path.stem == "stable_baselines":
        pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    (line,) = lines_on_top(path)
    arguments = shlex.split(line)[2:] + shlex.split(OF_FILES.get(path.name, LESS[path.parent.name]))
    monkeypatch.setattr("sys.argv", [str(path), *arguments])
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out


@pytest.fixture
def tables(monkeypatch, capsys):
    """Run the script that prints tables of policies."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", [str(TABLES), *map(str, arguments)])
        runpy.run_path(str(TABLES), run_name="__main__")
        lines = capsys.readouterr().out.splitlines()
        return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]

    return run


def results(folder, rows, steps=()):
    """Write what a job leaves: missions (method, regime, seed, return), and their steps."""
    folder.mkdir()
    (folder / "config.yaml").write_text(f"planner:\n  file: policies/{folder.name}.safetensors\n")
    names = ["method", "regime", "seed", "return"]
    pd.DataFrame(rows, columns=names).rename_axis("mission").to_csv(folder / "missions.csv")
    pd.concat([pd.DataFrame(), *steps]).to_parquet(folder / "steps.parquet")


def test_tables_of_policies(tmp_path, tables):
    returns = {"sac_0": (1.0, 2.0, 3.0), "sac_1": (3.0, 4.0, 5.0), "sac_randomised_0": (7.0,) * 3}
    for policy, values in returns.items():
        results(tmp_path / policy, [("physics", "reversed", *pair) for pair in enumerate(values)])
    table = tables(*tmp_path.iterdir())
    assert table[0] == ["change", "alone", "randomised"]
    change, alone, randomised = table[2]
    assert (change, randomised) == ("reversed", "7.0 [7.0, 7.0]")
    mean, low, high = map(float, re.findall(r"\d\.\d", alone))
    assert mean == 3.0 and 1.0 <= low < 3.0 < high <= 5.0
    assert table[3:] == [["alone: 2 policies, 3 episodes"], ["randomised: 1 policies, 3 episodes"]]


def test_tables_tell_when_the_reward_has_recovered(tmp_path, tables):
    """The change comes at step 10 of 100; it costs 1.5 a step for 30 steps, or for ever."""
    rows = [("physics", "nominal", 0, 0.0), ("physics", "reversed", 0, 0.0)]
    rows += [("afm_physics", "reversed", 0, 0.0), ("oracle", "reversed", 0, 0.0)]
    steps = [
        pd.DataFrame({"mission": mission, "regime_active": [0] * 10 + [1] * 90, "reward": -1.0})
        for mission in range(len(rows))
    ]
    steps[1].loc[10:, "reward"] = -2.5
    steps[2].loc[10:39, "reward"] = -2.5  # the 20 steps from 29 after the change on miss .075
    results(tmp_path / "sac", rows, steps)
    table = tables(tmp_path, "--measure", "recovered", "--digits", 0)
    assert table[0] == ["change", "alone", "AFM", "told"]
    assert table[2] == ["reversed", "∞ [∞, ∞]", "29 [29, 29]", "0 [0, 0]"]
