"""The examples run, by the line on top of each file, with less to do; deploy: test_deploy.py."""

import re
import runpy
import shlex
from pathlib import Path

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
    monkeypatch.chdir(tmp_path)
    (line,) = lines_on_top(path)
    arguments = shlex.split(line)[2:] + shlex.split(OF_FILES.get(path.name, LESS[path.parent.name]))
    monkeypatch.setattr("sys.argv", [str(path), *arguments])
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out


def test_tables_of_policies(tmp_path, monkeypatch, capsys):
    returns = {"sac_0": (1.0, 2.0, 3.0), "sac_1": (3.0, 4.0, 5.0), "sac_randomised_0": (7.0,) * 3}
    for policy, values in returns.items():
        folder = tmp_path / policy
        folder.mkdir()
        (folder / "config.yaml").write_text(f"planner:\n  file: policies/{policy}.safetensors\n")
        rows = [f"physics,reversed,{seed},{value}\n" for seed, value in enumerate(values)]
        (folder / "missions.csv").write_text("method,regime,seed,return\n" + "".join(rows))
    monkeypatch.setattr("sys.argv", [str(TABLES), *map(str, tmp_path.iterdir())])
    runpy.run_path(str(TABLES), run_name="__main__")
    table = capsys.readouterr().out.splitlines()
    assert table[0] == "| change | alone | randomised |"
    change, alone, randomised = (cell.strip() for cell in table[2].strip("|").split("|"))
    assert (change, randomised) == ("reversed", "7.0 [7.0, 7.0]")
    mean, low, high = map(float, re.findall(r"\d\.\d", alone))
    assert mean == 3.0 and 1.0 <= low < 3.0 < high <= 5.0
    assert table[3:] == ["alone: 2 policies, 3 episodes", "randomised: 1 policies, 3 episodes"]
