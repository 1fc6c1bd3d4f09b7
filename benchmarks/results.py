"""Measured tables and figures that README, docs and suites show.

    python benchmarks/results.py               # list the results with their age in commits
    python benchmarks/results.py NAME ...      # measure again, and fill the pages
    python benchmarks/results.py --fill        # fill the pages from the files

A result is a file, `benchmarks/results/NAME.json`. You write its ``commands``, its ``seeds`` in
words, the ``figures`` that the commands draw, what they ``need`` that is not in the repository
(path and SHA-256), ``gpu`` (true if they need one), and the ``names`` that pages use for rows and
columns. A renewal writes the other fields: the ``tables`` that the commands printed, the
``commit``, the versions, the machine, and the seconds of processor time.

A page shows a table between `<!-- result NAME: TABLE -->` and `<!-- end -->`; TABLE is the line
that the command printed above it; `machines: all` lists what the results ran on. Within a sentence
`<!-- result NAME: TABLE | ROW | COLUMN -->` shows a cell without its interval; such a mark must not
begin a line, because it would end the paragraph.

Commands run in `outputs/results/NAME`, beside links to the repository. If a renewal is interrupted,
the same command resumes it, unless the code has changed meanwhile.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CODE = ("afm_rl", "envs", "conf", "benchmarks/**/*.py", "benchmarks/**/*.yaml", "examples")
MARK = re.compile(
    r"(<!-- result ([\w-]+): ([^|>]+?)(?: \| ([^|>]+?) \| ([^|>]+?))? -->).*?(<!-- end -->)",
    re.DOTALL,
)
Result = dict[str, Any]
UNMEASURED = {
    "tables": {},
    "commit": "never",
    "versions": {"python": "-", "torch": "-"},
    "machine": "not measured",
}


def load(name: str) -> Result:
    """Return a result, or exit with a line that lists the results that exist."""
    if name == "machines":
        return {"tables": {"all": machines()}}
    file = ROOT / "benchmarks" / "results" / f"{name}.json"
    if not file.is_file():
        raise SystemExit(f"{name}: no such result; there are {', '.join(names())}")
    return UNMEASURED | json.loads(file.read_text(encoding="utf-8"))


def save(name: str, result: Result) -> None:
    """Write a result."""
    from afm_rl.storage.files import write_whole  # another renewal may be running

    text = json.dumps(result, indent=1, ensure_ascii=False)
    write_whole(ROOT / "benchmarks" / "results" / f"{name}.json", f"{text}\n".encode())


def names() -> list[str]:
    """Return the names of the results."""
    return sorted(file.stem for file in (ROOT / "benchmarks" / "results").glob("*.json"))


def machines() -> list[str]:
    """Return a table of the versions and machines that the results ran on."""
    ran: dict[str, list[str]] = {}
    for name in names():
        versions, machine = (result := load(name))["versions"], result["machine"]
        on = f"{versions['python']} | {versions['torch']} | {machine}"
        ran.setdefault(on, []).append(f"{name} ({result['commit']})")
    cells = {on: ", ".join(r) if len(r) < 5 else f"the other {len(r)}" for on, r in ran.items()}
    rows = [f"| {on} | {cells[on]} |" for on in sorted(ran, key=lambda on: len(ran[on]))]
    return ["| Python | torch | machine | results (commit) |", "|---|---|---|---|", *rows]


def git(*arguments: str) -> str:
    """Return what git prints in the repository; empty if the command fails."""
    command = ["git", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def commit() -> str:
    """Return the last commit that changed the code, marked if the working tree differs from it."""
    differs = git("status", "--porcelain", "--", *CODE)
    return git("log", "-1", "--format=%h", "--", *CODE) + (", changed" if differs else "")


def age(result: Result) -> str:
    """Return how many commits have changed the code since a result was measured."""
    measured = result["commit"].partition(",")[0]
    return git("rev-list", "--count", f"{measured}..HEAD", "--", *CODE) or "unknown"


def missing(result: Result) -> list[str]:
    """Return what a result needs that is absent or different here."""

    def digest(path: Path) -> str:
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""

    absent = [file for file, sha in result.get("need", {}).items() if digest(ROOT / file) != sha]
    no_gpu = result.get("gpu") and shutil.which("nvidia-smi") is None
    return absent + (["a GPU"] if no_gpu else [])


def renew(name: str) -> None:
    """Run the commands of a result, or the rest of them; write its file and fill the pages."""
    result = load(name)
    if absent := missing(result):
        raise SystemExit(f"{name}: cannot be measured here, because it needs {', '.join(absent)}")
    folder = ROOT / "outputs" / "results" / name
    progress = begin(name, result["commands"], folder)
    for command in result["commands"][len(progress["printed"]) :]:
        print(f"{name}: {command}", flush=True)
        run(name, command, folder, progress)
    printed = {"tables": tables_of("".join(progress["printed"])), "commit": progress["commit"]}
    save(name, result | printed | surroundings() | {"seconds": round(progress["seconds"])})
    (folder / "progress.json").unlink()
    fill_pages()


def begin(name: str, commands: list[str], folder: Path) -> Result:
    """Make the folder of a result, or find it; return how far its commands have run."""
    progress = {"commands": commands, "commit": commit(), "printed": [], "seconds": 0.0}
    file = folder / "progress.json"
    if file.is_file():
        earlier = json.loads(file.read_text(encoding="utf-8"))
        if [earlier["commands"], earlier["commit"]] == [commands, progress["commit"]]:
            return earlier
        print(f"{name}: starts again, because the code or the commands have changed", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path in ROOT.iterdir():
        if path.name not in (".git", "outputs"):
            (folder / path.name).symlink_to(path)
    file.write_text(json.dumps(progress), encoding="utf-8")
    return progress


def run(name: str, command: str, folder: Path, progress: Result) -> None:
    """Run a command in the folder of a result, and store what it printed."""
    settings = {"AFM_RL_CACHE": f"{folder / 'cache'}", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    settings["PATH"] = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
    start = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=os.environ | settings,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    progress["seconds"] += end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime
    if done.returncode == 0:
        progress["printed"].append(done.stdout)
    (folder / "progress.json").write_text(json.dumps(progress), encoding="utf-8")
    if done.returncode:
        print(done.stdout[-2000:])
        raise SystemExit(f"{name}: ended with status {done.returncode}: {command}")


def surroundings() -> Result:
    """Return the versions and the machine of this process."""
    cpu = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.*)", cpu.read_text()) if cpu.is_file() else None
    libraries = {name: version(name) for name in ("afm-rl", "torch", "torchrl", "mujoco")}
    return {
        "versions": {"python": platform.python_version(), **libraries},
        "machine": f"{model[1] if model else platform.machine()}, {os.cpu_count()} cores",
    }


def tables_of(text: str) -> dict[str, list[str]]:
    r"""Return the Markdown tables of a text, by the line above each; the last of one name.

    >>> tables_of("Errors:\n\n| a |\n|---|\n| 1 |\n")
    {'Errors': ['| a |', '|---|', '| 1 |']}
    """
    found: dict[str, list[str]] = {}
    title, above = "", ""
    for line in text.splitlines():
        if line.startswith("|"):
            found[title] = [*found[title], line] if above.startswith("|") else [line]
        elif line.strip():
            title = line.strip().rstrip(":")
        above = line
    return found


def renamed(table: list[str], names: dict[str, str]) -> list[str]:
    """Return the lines of a table with other names of columns and rows.

    >>> renamed(["| | b |", "|---|---|", "| half | half |"], {"half": "1/2", "b": "B"})
    ['| | B |', '|---|---|', '| 1/2 | half |']
    """
    cell = re.compile(r"(?<=\| )[^|]+(?= \|)")
    columns, *rows = table

    def name(match: re.Match[str]) -> str:
        return names.get(match[0], match[0])

    return [cell.sub(name, columns), *(cell.sub(name, row, count=1) for row in rows)]


def pages() -> list[Path]:
    """Return the pages that may show results."""
    shown = ("README.md", "docs/**/*.md", "benchmarks/suites/*/README.md")
    return [page for pattern in shown for page in sorted(ROOT.glob(pattern))]


def filled(page: Path) -> str:
    """Return a page with the tables and cells of the results between its marks."""

    def fill(match: re.Match[str]) -> str:
        begin, name, title, row, column, end = match.groups()
        result = load(name)
        tables, names = result["tables"], result.get("names", {})
        if title not in tables:
            raise SystemExit(f"{page}: {begin}: expected a table of {', '.join(tables)}")
        if row is None:
            return "\n".join([begin, *renamed(tables[title], names), end])
        cells = [[c.strip(" *") for c in line.split("|")[1:-1]] for line in tables[title]]
        values = [dict(zip(cells[0], c, strict=True)).get(column) for c in cells if c[0] == row]
        if len(values) != 1 or values[0] is None:
            raise SystemExit(f"{page}: {begin}: expected a row and a column of that table")
        return begin + values[0].partition(" [")[0] + end

    return MARK.sub(fill, page.read_text(encoding="utf-8"))


def fill_pages() -> None:
    """Write the results into the pages."""
    from afm_rl.storage.files import write_whole

    for page in pages():
        write_whole(page, filled(page).encode())


def show() -> None:
    """Print the results: age, cost, and what is missing to measure them here."""
    print(f"{'result':22}{'commits since':>14}{'minutes':>9}  machine")
    for name in names():
        result = load(name)
        absent = f"; needs {', '.join(missing(result))}" if missing(result) else ""
        cost = f"{result['seconds'] / 60:.1f}" if "seconds" in result else "?"
        print(f"{name:22}{age(result):>14}{cost:>9}  {result['machine']}{absent}")


def main() -> None:
    """List, renew or fill in the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="results to measure again")
    parser.add_argument("--fill", action="store_true", help="fill the pages from the files")
    options = parser.parse_args()
    for name in options.names:
        renew(name)
    if options.fill:
        fill_pages()
    elif not options.names:
        show()


if __name__ == "__main__":
    main()
