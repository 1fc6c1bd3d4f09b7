"""Count the house: its rooms, what imports load, and the way of one action through it.

    python benchmarks/house.py
    python benchmarks/house.py --check   # is each room as large as its budget?
    python benchmarks/house.py --write   # lower the budgets to what there is

`rooms.py` says what a room is, and its size. Where a room shrinks, its budget follows in the same
commit. It rises by hand, where another one falls by as much. Programs run for the other counts:
imports, fifty steps of a pendulum behind ``ActionFlowTransform``, and a mission.
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
from collections.abc import Callable, Iterable
from pathlib import Path

import rooms
from digests import git
from results import lay_out
from rooms import Source

HERE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(HERE / "docs" / "theme"))
import layers  # noqa: E402

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
COMMAND = """
import tempfile
from afm_rl.cli import main

ends = {"build", "Core.decide", "UGVSimulation.advance"}

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
import json, os, sys
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
kinds = {"loaded": filter(None, loaded), "stacks": stacks, "called": called}
print(json.dumps({
    kind: {os.path.realpath(file): sorted(called.get(file, [])) for file in files}
    for kind, files in kinds.items()
}))
"""
IMPORTS = {
    "ActionFlowTransform": "from afm_rl.transforms import ActionFlowTransform",
    "ActionFlowWrapper": "from afm_rl import ActionFlowWrapper; ActionFlowWrapper",
}
HYPOTHESES = "from afm_rl.correction.hypotheses import choose; print(len(choose(None, False, 0)))"
CORE = re.compile(
    r"afm_rl/(correction/(?!training|classical|paper_flow)"
    r"|dynamics/inverse\.py|transforms/(action_flow|loop)\.py)"
)
SAYING_NOTHING = {"part", "own", "given", "most", "found", "known", "one", "whole", "rest"}


def run(program: str) -> str:
    """Return what a program prints that imports the package."""
    with tempfile.TemporaryDirectory() as folder:
        lay_out(HERE, Path(folder))
        env = {**os.environ, "PYTHONPATH": folder, "AFM_RL_CORE": "eager"}
        command = [sys.executable, "-c", program]
        return subprocess.check_output(command, env=env, cwd=folder, text=True)


def trace(program: str, files: Iterable[str]) -> dict[str, dict[str, list[int]]]:
    """Run a program, and return which of some files it needs.

    Returns:
        Those that are ``loaded``, those on the ``stacks`` of a mission, and those with functions
        that the last step ``called``, with the first lines of these functions.
    """
    kinds = json.loads(run(BEGIN + program + END).splitlines()[-1])
    paths = {str(HERE / file): file for file in files}
    return {
        kind: {paths[path]: lines for path, lines in begun.items() if path in paths}
        for kind, begun in kinds.items()
    }


def of_functions(tree: ast.Module, begun: list[int]) -> int:
    """Return how many lines the functions have that begin at some lines."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            first = min(part.lineno for part in (node, *node.decorator_list))
            if first in begun:
                lines |= set(range(first, (node.end_lineno or first) + 1))
    return len(lines)


def says_nothing(node: ast.AST) -> bool:
    """Return whether a variable or an argument has a name that says nothing."""
    match node:
        case ast.Name(name, ast.Store()) | ast.arg(name):
            return name in SAYING_NOTHING
    return False


def is_option(node: ast.AST) -> bool:
    """Return whether an option is described: an annotation that holds a text."""
    match node:
        case ast.Subscript(ast.Name("Annotated"), ast.Tuple(notes)):
            return any(isinstance(getattr(note, "value", None), str) for note in notes)
    return False


def count(files: dict[str, Source]) -> dict[str, str]:
    """Return the rows of the table."""
    texts = {n: (HERE / n).read_text() for n in git(HERE, "ls-files", "*.py", "*.md")}
    trees = {name: ast.parse(text) for name, text in texts.items() if name.endswith(".py")}
    package = {name: trees[name] for name in trees if name.startswith(("afm_rl/", "envs/"))}
    pages = [text for name, text in texts.items() if re.match(r"(README|docs/.*)\.md", name)]
    words = [len(re.sub("<!--.*?-->", "", text).split()) for text in pages]

    def lines(names: Iterable[str]) -> str:
        return f"{sum(files[name].lines for name in names):,}"

    def nodes(is_one: Callable[[ast.AST], bool], among: dict[str, ast.Module]) -> str:
        return f"{sum(is_one(node) for tree in among.values() for node in ast.walk(tree)):,}"

    rows = {}
    for name, program in IMPORTS.items():
        loaded = trace(program, files)["loaded"]
        rows[f"importing `{name}` loads: files; code lines"] = f"{len(loaded)}; {lines(loaded)}"
    called = trace(TRANSFORM, files)["called"]
    stacks = trace(COMMAND, files)["stacks"]
    of_called = sum(of_functions(trees[file], begun) for file, begun in called.items())
    return rows | {
        "library: code lines": lines(package),
        "core: code lines": lines(filter(CORE.match, package)),
        "one corrected action: files; code lines; lines of the functions it calls": (
            f"{len(called)}; {lines(called)}; {of_called:,}"
        ),
        "from the command line to the executed action: files": f"{len(stacks)}",
        "options": nodes(is_option, package),
        "hypotheses": run(HYPOTHESES).strip(),
        "circles of imports": f"{len(layers.circles())}",
        "names that say nothing": nodes(says_nothing, trees),
        "docs: words": f"{sum(words):,}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare rooms with their budgets")
    parser.add_argument("--write", action="store_true", help="lower budgets to what there is")
    options = parser.parse_args()
    files = rooms.sources(HERE)
    now = rooms.sizes(files)
    if options.write:
        rooms.lower(HERE, now)
    if options.check or options.write:
        sys.exit("\n".join(rooms.faults(now, *rooms.load(HERE))) or None)
    import pandas as pd  # both take longer than the check

    from afm_rl.report.tables import markdown

    budgets = pd.DataFrame(rooms.load(HERE)[0], dtype=object).T
    for title, counts in ("rooms", now), ("house", count(files)):
        table = pd.DataFrame({"now": counts}, dtype=object).join(budgets).fillna("")
        table = table.rename_axis("").reset_index()[["", "before", "now", "end"]]
        texts = table.map(lambda cell: cell if isinstance(cell, str) else f"{cell:,.6g}")
        print(markdown(title, texts))


if __name__ == "__main__":
    main()
