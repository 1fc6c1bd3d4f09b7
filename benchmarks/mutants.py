"""Mutants: one small mistake at a time in a copy of the tree, and the tests that must notice it.

    python benchmarks/mutants.py [-n 2] [--only TEXT] [--out outputs/mutants.jsonl]

``mutants.txt`` has them: a file, a line of it (``-``), and what becomes of the line (``+``). A
mutant is killed by the first of its file's tests that fails, or lives. Where the line is gone, or
is there twice, it does not apply: the same mistake is then written into ``mutants.txt`` in the
words of the new code. OUT is a line per mutant; what is in it is not run again, so that this can be
ended at any time. Delete it to begin anew.

    python benchmarks/mutants.py --draw 12 afm_rl/correction/core.py

draws mutants of a file. So were all drawn but those under "By hand".
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import tokenize
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pytest
import torchrl.data  # imported once for all: not the library, of which every process has its copy
import torchrl.envs  # noqa: F401

ROOT, LIST = Path(__file__).resolve().parents[1], Path(__file__).with_suffix(".txt")
FOLDERS = ("afm_rl", "benchmarks", "conf", "envs", "examples", "tests", "pyproject.toml")
CORRECTION = "core disturbances linear classical hypotheses belief delay action_flow golden"
TESTS = {  # of each file, those of the property first
    "afm_rl/correction/": [f"tests/correction/test_{name}.py" for name in CORRECTION.split()],
    "afm_rl/dynamics/inverse.py": [
        "tests/dynamics/test_inverse.py",
        "tests/dynamics/test_knode.py",
    ],
    "afm_rl/dynamics/": ["tests/transforms/test_odd_models.py", "tests/dynamics/test_mujoco.py"],
    "afm_rl/planning/": ["tests/planning/test_onnx_policy.py"],
    "afm_rl/transforms/record.py": ["tests/transforms/test_record.py"],
    "afm_rl/transforms/loop.py": [
        "tests/transforms/test_odd_models.py",
        "tests/transforms/test_action_flow_execution.py",
        "tests/transforms/test_shells.py::test_no_command_is_beyond_the_limits_and_what_they_leave_is_used",
        "tests/transforms/test_shells.py::test_it_is_said_that_limits_hold_the_correction_back",
        "tests/transforms/test_action_flow_memory.py",
    ],
    "afm_rl/compiling/": ["tests/compiling/test_library.py", "tests/correction/test_in_c.py"],
    "afm_rl/diagnosis/": [
        "tests/diagnosis/test_calibration.py",
        "tests/diagnosis/test_model_check.py",
    ],
    "examples/deploy/": [
        "tests/test_deploy.py::test_an_arm_of_lerobot_moves_as_planned_when_a_joint_is_reversed",
        "tests/test_deploy.py::test_the_wrapper_of_lerobot_has_its_interface_and_forgets_what_was_clipped",
    ],
}
SECONDS = 180  # of the processor, after which a mutant that goes on for ever is killed
PAIRS = "< > <= >= == != + - * / and or amin amax argmin argmax minimum maximum clamp_min clamp_max"
PAIRS = [*PAIRS.split(), "min", "max"]
SWAPS = {sign: PAIRS[k ^ 1] for k, sign in enumerate(PAIRS)} | {"&": "|"}


class Mutant(NamedTuple):
    """One small mistake."""

    file: str
    line: str
    becomes: str


def read_mutants(text: str) -> list[Mutant]:
    """Return the mutants of a list."""
    rows = re.findall(r"^(\S+)\n((?:- .*\n)+)((?:\+ .*\n)+)", text, re.M)
    return [Mutant(*(re.sub("^[-+] ", "", field, flags=re.M) for field in row)) for row in rows]


def written(mutant: Mutant) -> str:
    """Return a mutant as it is in the list."""
    rows = [
        f"{sign} {row}"
        for sign, text in zip("-+", mutant[1:], strict=True)
        for row in text.splitlines(keepends=True)
    ]
    return "".join([f"{mutant.file}\n", *rows])


def run(mutant: Mutant) -> dict[str, Any]:
    """Return what becomes of a mutant, in a copy of the tree."""
    source = (ROOT / mutant.file).read_text(encoding="utf-8")
    if mutant.line and source.count(mutant.line) != 1:
        return {**mutant._asdict(), "outcome": "does not apply", "by": ""}
    with tempfile.TemporaryDirectory() as folder:
        listed = subprocess.check_output(["git", "ls-files", "-z", *FOLDERS], cwd=ROOT, text=True)
        for name in filter(None, listed.split("\0")):
            copied = Path(folder, name)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copied)
        for name in ("envs", "conf"):  # as they are installed
            Path(folder, "afm_rl", name).symlink_to(f"../{name}")
        Path(folder, mutant.file).write_text(source.replace(mutant.line, mutant.becomes))
        outcome, by = tested(folder, mutant.file)
    return {**mutant._asdict(), "outcome": outcome, "by": by}


def tests_of(file: str) -> list[str]:
    """Return the tests of a file."""
    return next(tests for start, tests in TESTS.items() if file.startswith(start))


def tested(folder: str, file: str) -> tuple[str, str]:
    """Run the tests of a file in a tree; return what becomes of a mutant, and by which test."""
    signal.signal(signal.SIGVTALRM, lambda *_: sys.exit("it goes on"))
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    os.chdir(folder)
    sys.path[0], sys.argv = folder, ["pytest"]
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    failed: list[str] = []

    class Notes:
        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            failed.extend([report.nodeid] if report.failed else [])

        def pytest_collectreport(self, report: pytest.CollectReport) -> None:
            failed.extend([f"import of {report.nodeid}"] if report.failed else [])

    options = ["-x", "-q", "-m", "not slow", "-k", "not processes"]  # a daemon may have none
    options += ["--timeout=0", "-p", "no:cacheprovider", *tests_of(file)]
    status = pytest.main(options, plugins=[Notes()])
    return ("lives", "") if status == 0 else ("killed", (failed or ["import"])[0])


def drawn(file: str, count: int, seed: int = 0) -> list[Mutant]:
    """Return mutants of a file: signs, comparisons, ends and constants that are others."""
    source, found = (ROOT / file).read_text(encoding="utf-8"), []
    rows = source.splitlines(keepends=True)
    for kind, text, (row, start), (_, end), _ in tokenize.generate_tokens(iter(rows).__next__):
        line, others = rows[min(row, len(rows)) - 1], []
        if kind == tokenize.NUMBER and "." in text and float(text):
            others = [repr(share * float(text)) for share in (0.5, 2)]
        elif text in SWAPS and (text.isalpha() or line[start - 1 : end + 1] == f" {text} "):
            others = [SWAPS[text]]  # not *args, nor the sign of an index
        first = row - 1
        while others and source.count("".join(rows[first:row])) > 1:
            first -= 1
        above = "".join(rows[first : row - 1])
        found += [Mutant(file, above + line, above + line[:start] + x + line[end:]) for x in others]
    return random.Random(f"{seed} {file}").sample(found, min(count, len(found)))


def main() -> None:
    """Run the mutants that have not been run, and tell what became of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=1, help="processes")
    parser.add_argument("--only", default="", help="mutants whose file has this in its name")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "mutants.jsonl")
    parser.add_argument("--draw", type=int, help="print so many new mutants of the files")
    parser.add_argument("files", nargs="*")
    arguments = parser.parse_args()
    if arguments.draw:
        for mutant in (m for file in arguments.files for m in drawn(file, arguments.draw)):
            print(written(mutant))
        return
    mutants = [m for m in read_mutants(LIST.read_text("utf-8")) if arguments.only in m.file]
    firsts = {tests_of(mutant.file)[0]: Mutant(mutant.file, "", "") for mutant in mutants}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with arguments.out.open("a+", encoding="utf-8") as file:
        file.seek(0)
        done = {Mutant(*list(row.values())[:3]): row for row in map(json.loads, file)}
        left = [mutant for mutant in [*firsts.values(), *mutants] if mutant not in done]
        with multiprocessing.get_context("fork").Pool(arguments.n, maxtasksperchild=1) as pool:
            for row in pool.imap_unordered(run, left):
                print(json.dumps(row), file=file, flush=True)
                done[Mutant(*list(row.values())[:3])] = row
                print(f"{len(done)}: {row['outcome']} {row['by']} {row['file']}", flush=True)
                if not row["line"] and row["outcome"] != "lives":
                    raise SystemExit(f"{row['by']} fails without a mutant, too")
    frame = pd.DataFrame([done[mutant] for mutant in mutants])
    print(pd.crosstab(frame["file"], frame["outcome"], margins=True).to_string())
    for row in frame[frame["outcome"] != "killed"].to_dict("records"):
        print(f"\n{row.pop('outcome')}:\n{written(Mutant(*list(row.values())[:3]))}", end="")


if __name__ == "__main__":
    main()
