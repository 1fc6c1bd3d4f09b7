"""The examples run, by the line on top of each file, with less to do; deploy: test_deploy.py."""

import re
import runpy
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LESS = {
    "transform": "",
    "learn": "--batches 2 --samples 512",
    "compare": "--methods physics oracle --budget 10",
    "policies": "--steps 40 --at 20",
    "torchrl": "",
}
OF_FILES = {  # where the examples of a folder differ
    "stable_baselines.py": "--steps 64 --episodes 1",
    "belief.py": "--steps 5 --out belief.png",
    "train_sac.py": "--id Pendulum-v1 --steps 60 --first 40 --out policy.safetensors",
    "collect.py": "--frames 200",
    "sac.py": "--frames 200 --random 100 --units 8 --tested 20",
    "ppo.py": "--batches 2 --frames 64 --epochs 1 --units 8 --tested 20 --start fork",
    "workers.py": "--steps 20 --start fork",
    "resume.py": "--episodes 2 --steps 20 --units 8",
}
FILES = [path for verb in LESS for path in sorted((ROOT / "examples" / verb).glob("*.py"))]
LONG = {"collect.py", "follow_a_clock.py", "ppo.py", "resume.py", "sac.py", "stable_baselines.py"}
LONG |= {"swing_up.py", "workers.py"}  # these run every night
FILES.append(ROOT / "examples" / "explain_afm" / "belief.py")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path,
            id=f"{path.parent.name}-{path.stem}",
            marks=pytest.mark.slow if path.name in LONG else [],
        )
        for path in FILES
    ],
)
def test_examples_run(path, short_trainings, monkeypatch, tmp_path, capsys):
    if path.parent.name == "policies" or path.stem == "belief":
        pytest.importorskip("mujoco")
    if path.stem == "stable_baselines":
        pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(path.parent))
    (line,) = re.findall(r"(?:^ {4}|``)(python examples/[^\n`]*)", path.read_text(), re.MULTILINE)
    _, name, *arguments = shlex.split(line)
    assert ROOT / name == path
    arguments += shlex.split(OF_FILES.get(path.name) or LESS[path.parent.name])
    monkeypatch.setattr("sys.argv", [str(path), *arguments])
    runpy.run_path(str(path), run_name="__main__")
    said = capsys.readouterr().out
    assert said
    if path.name == "resume.py":
        assert "continues with episode 1, 20" in said and "the same weights: True" in said
