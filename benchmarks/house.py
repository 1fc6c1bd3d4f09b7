"""Count the house: what it holds, what its parts load, and the way of one action through it.

    python benchmarks/house.py [ROOT] [--time]

Lines, classes and constants are those of ``afm_rl`` and ``envs`` in ROOT. A constant is a name in
capitals that a module assigns, once for each. Three programs run: fifty steps of a pendulum behind
``ActionFlowTransform``, fifty behind ``ActionFlowWrapper``, and a mission by the command line.
``--time`` runs ``make test`` and ``.ci/run``, too.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from afm_rl.report.tables import markdown

HERE = Path(__file__).resolve().parents[1]
TRANSFORM = """
import torch
from torchrl.envs import GymEnv, TransformedEnv, step_mdp
from afm_rl.dynamics import KnownDynamics
from afm_rl.spaces.manifold import Manifold
from afm_rl.transforms import ActionFlowTransform

def dynamics(state, action):
    th, w = torch.atan2(state[..., 1], state[..., 0]), state[..., 2]
    w = (w + 0.05 * (15 * th.sin() - 3 * action[..., 0].clamp(-2, 2))).clamp(-8, 8)  # reversed
    th = th + 0.05 * w
    return torch.stack([th.cos(), th.sin(), w], -1)

model = KnownDynamics(dynamics, Manifold(3), 1)
env = TransformedEnv(GymEnv("Pendulum-v1"), ActionFlowTransform(model))
torch.manual_seed(0)
corrected, td = 0, env.reset()
for _ in range(50):
    td = trace(env.step, env.rand_action(td))
    corrected += td["next", "afm", "misaligned"].item()
    td = step_mdp(td)
"""
WRAPPER = """
import gymnasium
from afm_rl import ActionFlowWrapper

class Reversed(gymnasium.ActionWrapper):
    def action(self, action):
        return -action

env = ActionFlowWrapper(Reversed(gymnasium.make("InvertedPendulum-v5")), model="mujoco")
env.action_space.seed(0)
env.reset(seed=0)
corrected = 0
for _ in range(50):
    _, _, ended, _, info = trace(env.step, env.action_space.sample())
    corrected += info["afm"]["corrects"]
    if ended:
        env.reset()
"""
COMMAND = """
import tempfile
from afm_rl.cli import main

ends = {"build", "Tick.forward", "UGVSimulation.advance"}

def follow(frame, event, argument):
    code = frame.f_code
    if event == "call" and code.co_qualname in ends and "afm_rl" in code.co_filename:
        ends.remove(code.co_qualname)
        while frame:
            stacks.add(frame.f_code.co_filename)
            frame = frame.f_back

sys.argv = ["afm-rl", "method=afm_physics", "budget=60", "seeds=[0]", "figures=false"]
sys.argv += ["planner.population=16", "hydra.run.dir=" + tempfile.mkdtemp()]
sys.setprofile(follow)
main()
sys.setprofile(None)
assert not ends, f"never reached: {ends}"
"""
BEGIN = """
import json, sys
called, stacks = {}, set()

def trace(step, action):
    def note(frame, event, argument):
        if event == "call":
            called.setdefault(frame.f_code.co_filename, set()).add(frame.f_code.co_firstlineno)
    called.clear()
    sys.setprofile(note)
    try:
        return step(action)
    finally:
        sys.setprofile(None)
"""
END = """
assert globals().get("corrected", 1) > 0, "nothing was corrected"
loaded = [m.__file__ for name, m in sys.modules.items() if name.partition(".")[0] == "afm_rl"]
called = {file: sorted(lines) for file, lines in called.items()}
print(json.dumps({"loaded": loaded, "stacks": sorted(stacks), "called": called}))
"""
BEYOND = {"diagnosis", "learning", "missions", "planning", "report"}
BEFORE = {  # of commit bbecb0c
    "`ActionFlowTransform` loads: files; lines; of five rooms": "78; 12,900; planning",
    "`ActionFlowWrapper` loads: files; lines; of five rooms": (
        "113; 19,188; diagnosis, learning, planning"
    ),
    "`afm_rl` and `envs`: files; lines": "209; 34,905",
    "classes": "246",
    "module constants": "348",
    "all tracked `.py`: lines": "67,892",
    "tests: lines": "26,677",
    "docs: words": "23,032",
    "one corrected action: files; their lines; lines of the functions it calls": (
        "25; 4,853; 1,648"
    ),
    "from the command line to the executed action: files": "15",
    "`make test`: minutes": "8",
    "`.ci/run`: minutes": "12",
}


def run(program: str, root: Path = HERE) -> dict[str, dict[str, list[int]]]:
    """Run a program with the package in a folder.

    Returns:
        Files of the package, from ``root``: those that are ``loaded``, those on the ``stacks`` of
        a mission, and those with functions that the last step ``called``, with the first lines of
        these functions.
    """
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder, "afm_rl")  # laid out as the wheel is
        package.mkdir()
        for part in (*(root / "afm_rl").iterdir(), root / "envs", root / "conf"):
            (package / part.name).symlink_to(part.resolve())
        settings = {**os.environ, "PYTHONPATH": folder, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-c", BEGIN + program + END]
        out = subprocess.check_output(command, env=settings, cwd=folder, text=True)
        kinds = json.loads(out.splitlines()[-1])
        return {
            kind: {
                str(Path(file).resolve().relative_to(root)): kinds["called"].get(file, [])
                for file in files
                if file and file.startswith(folder)
            }
            for kind, files in kinds.items()
        }


def rooms(files: Iterable[str]) -> set[str]:
    """Return the folders, and the modules beside them, that files lie in."""
    return {Path(file).parts[1].removesuffix(".py") for file in files if file.startswith("afm_rl/")}


def constants(tree: ast.Module) -> int:
    """Return how many names in capitals a module assigns."""
    named = [
        name.id
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        for name in ast.walk(target)
        if isinstance(name, ast.Name)
    ]
    return sum(name.lstrip("_").isupper() for name in named)


def of_functions(tree: ast.Module, begun: list[int]) -> int:
    """Return how many lines the functions have that begin at some lines."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            first = min(part.lineno for part in (node, *node.decorator_list))
            if first in begun:
                lines |= set(range(first, (node.end_lineno or first) + 1))
    return len(lines)


def minutes(root: Path, command: list[str]) -> str:
    """Return how long a command takes."""
    start = time.perf_counter()
    subprocess.run(command, cwd=root, check=True, stdout=subprocess.DEVNULL)
    return f"{(time.perf_counter() - start) / 60:.1f}"


def count(root: Path) -> dict[str, str]:
    """Return the rows of the table."""
    names = subprocess.check_output(["git", "ls-files"], cwd=root, text=True).splitlines()
    texts = {name: (root / name).read_text() for name in names if name.endswith((".py", ".md"))}
    code = {name: text for name, text in texts.items() if name.endswith(".py")}
    trees = {n: ast.parse(t) for n, t in code.items() if n.startswith(("afm_rl/", "envs/"))}
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    pages = [t for n, t in texts.items() if re.match(r"(README|docs/.*)\.md", n)]
    words = [len(re.sub("<!--.*?-->", "", text).split()) for text in pages]

    def lines(files: Iterable[str]) -> str:
        return f"{sum(code[file].count(chr(10)) for file in files):,}"

    def load(program: str) -> tuple[str, dict[str, list[int]]]:
        ran = run(program, root)
        beyond = ", ".join(sorted(rooms(ran["loaded"]) & BEYOND)) or "none"
        return f"{len(ran['loaded'])}; {lines(ran['loaded'])}; {beyond}", ran["called"]

    transform, called = load(TRANSFORM)
    stacks = run(COMMAND, root)["stacks"]
    of_called = sum(of_functions(trees[file], begun) for file, begun in called.items())
    return {
        "`ActionFlowTransform` loads: files; lines; of five rooms": transform,
        "`ActionFlowWrapper` loads: files; lines; of five rooms": load(WRAPPER)[0],
        "`afm_rl` and `envs`: files; lines": f"{len(trees)}; {lines(trees)}",
        "classes": f"{sum(isinstance(node, ast.ClassDef) for node in nodes)}",
        "module constants": f"{sum(map(constants, trees.values()))}",
        "all tracked `.py`: lines": lines(code),
        "tests: lines": lines(n for n in code if n.startswith("tests/")),
        "docs: words": f"{sum(words):,}",
        "one corrected action: files; their lines; lines of the functions it calls": (
            f"{len(called)}; {lines(called)}; {of_called:,}"
        ),
        "from the command line to the executed action: files": f"{len(stacks)}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path, nargs="?", default=HERE)
    parser.add_argument("--time", action="store_true", help="run make test and .ci/run, too")
    options = parser.parse_args()
    rows = count(options.root.resolve())
    for name, command in (("make test", ["make", "test"]), (".ci/run", [".ci/run"])):
        if options.time:
            rows[f"`{name}`: minutes"] = minutes(options.root, command)
    table = {"": list(rows), "before": [BEFORE[name] for name in rows], "now": list(rows.values())}
    print(markdown("house", pd.DataFrame(table)))


if __name__ == "__main__":
    main()
