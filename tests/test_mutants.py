"""Mutants are killed by tests that notice them; what is among the results is not run again."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

PROGRAM = Path(__file__).parents[1] / "benchmarks" / "mutants.py"
FILE, TEST = "afm_rl/transforms/record.py", "tests/transforms/test_record.py"
MUTANT = FILE + "\n-     return {}  # a half\n+     return {}\n\n"
TREE = {
    FILE: "def half(x):\n    return x / 2  # a half\n",
    TEST: "import afm_rl.transforms.record as c\ndef test_it():\n    assert c.half(2) == 1\n",
    "benchmarks/mutants.txt": MUTANT.format("x / 2", "2 * x")
    + MUTANT.format("x / 2", "x // 2")
    + MUTANT.format("0.5 * x", "x"),
}
TREE |= dict.fromkeys(["torchrl/__init__.py", "torchrl/data.py", "torchrl/envs.py"], "")  # slow


def test_a_mutant_is_killed_or_lives_or_does_not_apply(tmp_path):
    for name, text in TREE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    shutil.copy(PROGRAM, tmp_path / "benchmarks")

    def run(*command):
        where = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": str(tmp_path)}}
        return subprocess.run(command, check=True, capture_output=True, text=True, **where)

    run("git", "init", "-q")
    run("git", "add", ".")
    for lines in (4, 0):  # the tests without a mutant, and three with one
        said = run(sys.executable, "benchmarks/mutants.py").stdout
        steps, _, table = said.partition("outcome")
        assert len(steps.splitlines()) == lines
        assert f"lives:\n{MUTANT.format('x / 2', 'x // 2')}".strip() in table
        assert f"does not apply:\n{MUTANT.format('0.5 * x', 'x')}".strip() in table
        assert table.split(f"\n{FILE}")[1].split()[:4] == ["1", "1", "1", "3"]
