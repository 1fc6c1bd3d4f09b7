"""Measured tables and figures of README and docs: are they of today's code, and what renews them?

    python benchmarks/results.py                      # list them
    python benchmarks/results.py --renew NAME ...     # measure again; `all`: whatever is stale
    python benchmarks/results.py --write              # put what the files say into the pages

A result is a file, `benchmarks/results/NAME.json`. By hand: its ``commands``, as a page prints
them, ``seeds`` in words, ``figures`` that they draw, patterns of data that C++ ``reads``, unseen by
Python, what they ``need`` that is not in the repository, with SHA-256, and ``gpu``: true, where
they need one. The rest is written by ``--renew``: the ``tables`` that they printed, versions,
machine, seconds of processor time, and the ``code``: a digest of each file of the repository that
was read (`digests.py`), and their last ``commit``. A result is stale when one of these has another
digest now. One without code is older than these files.

A page shows a table between `<!-- result NAME: TABLE -->` and `<!-- end -->`; TABLE is what its
command printed above it. Within a sentence `<!-- result NAME: TABLE | ROW | COLUMN -->` shows a
cell, without its interval; such a mark does not begin a line, where it would end the paragraph.

``--renew`` works in `outputs/results/NAME`, beside links to the repository. If it is ended, the
same command goes on there, unless code that was read has changed.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import fnmatch
import hashlib
import importlib.util
import json
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from digests import digest, packed, unpacked

ROOT = Path(__file__).resolve().parents[1]
MARK = re.compile(
    r"(<!-- result ([\w-]+): ([^|>]+?)(?: \| ([^|>]+?) \| ([^|>]+?))? -->).*?(<!-- end -->)",
    re.DOTALL,
)
HOOK = """
import os, sys

seen = set()

def note(event, arguments):
    if event == "open" and isinstance(arguments[0], str) and arguments[0] not in seen:
        if not arguments[2] & (os.O_WRONLY | os.O_RDWR):
            seen.add(arguments[0])
            with open(os.environ["RESULTS_READ"], "a") as file:
                file.write(os.path.abspath(arguments[0]) + "\\n")

sys.addaudithook(note)
"""  # sitecustomize of every Python that a command starts; who imports a module opens its file
SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER: orphans become our children
BEGUN, READ = "begun.json", "read.txt"  # in the folder of a result
Result = dict[str, Any]


def load(name: str) -> Result:
    """Return a result, or end in a line that says which there are."""
    file = ROOT / "benchmarks" / "results" / f"{name}.json"
    if not file.is_file():
        raise SystemExit(f"{name}: no such result; there are {', '.join(names())}")
    return json.loads(file.read_text(encoding="utf-8"))


def names() -> list[str]:
    return sorted(file.stem for file in (ROOT / "benchmarks" / "results").glob("*.json"))


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def code_now() -> dict[str, str]:
    """Return the digest of every file that may count: all of the repository but its texts."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    files = subprocess.check_output(listed, cwd=ROOT, text=True).splitlines()
    counted = (f for f in files if not f.startswith(("docs/", "benchmarks/results/")))
    return {f: digest(ROOT / f)[:8] for f in counted if not f.endswith(".md")}


def asked(result: Result) -> str:
    """Return the digest of what is written by hand."""
    text = json.dumps([result["commands"], result.get("need")])
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def reasons(result: Result) -> tuple[str, str]:
    """Return why a result is stale, and why it cannot be renewed here; empty where it is not."""
    code = unpacked(result.get("code", {}))
    old = result.get("asked")
    changed = [f for f, value in code.items() if digest(ROOT / f)[:8] != value]
    why = f"never renewed, of {result.get('commit', 'no commit')}" if old is None else ""
    if changed:
        why = changed[0] + (f" and {len(changed) - 1} more changed" if changed[1:] else " changed")
    elif old not in (None, asked(result)):
        why = "its commands changed"
    need = result.get("need", {})
    absent = [file for file, value in need.items() if digest(ROOT / file) != value]
    if result.get("gpu") and shutil.which("nvidia-smi") is None:
        absent.append("a GPU")
    return why, f"needs {', '.join(absent)}" if absent else ""


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


def filled(page: Path) -> str:
    """Return a page with what the results say between its marks."""

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


def write_pages() -> None:
    for page in pages():
        page.write_text(filled(page), encoding="utf-8")


def renew(name: str) -> None:
    """Run the commands of a result in a folder of its own, or go on there; write file and pages."""
    digest.cache_clear()
    result = load(name)
    if reasons(result)[1]:
        raise SystemExit(f"{name}: cannot be renewed here: it {reasons(result)[1]}")
    folder = ROOT / "outputs" / "results" / name
    begun = begin(name, result, folder)
    settings = {"PYTHONPATH": f"{folder / 'hook'}", "RESULTS_READ": f"{folder / READ}"}
    settings |= {"AFM_RL_CACHE": f"{folder / 'cache'}", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    settings["PATH"] = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
    printed, start = "", processor_seconds()
    try:
        for command in result["commands"]:
            print(f"{name}: {command}", flush=True)
            printed += subprocess.check_output(
                ["bash", "-c", command], cwd=folder, env=os.environ | settings, text=True
            )
    except subprocess.CalledProcessError as error:
        print(error.output[-2000:])
        raise SystemExit(f"{name}: ended with status {error.returncode}: {command}") from None
    finally:
        begun["seconds"] += processor_seconds() - start
        (folder / BEGUN).write_text(json.dumps(begun), encoding="utf-8")
    digest.cache_clear()
    files = files_in(folder / READ)
    for pattern in result.get("reads", []):
        files |= {*fnmatch.filter(begun["code"], pattern)}
    code = {file: value for file, value in begun["code"].items() if file in files}
    result |= {
        "figures": {file: digest(ROOT / file) for file in result["figures"]},
        "tables": tables_of(printed),
        "commit": commit_of([*code]),
        "versions": {"python": platform.python_version()}
        | {part: version(part) for part in ("afm-rl", "torch", "torchrl", "mujoco")},
        "machine": f"{processor()}, {os.cpu_count()} cores",
        "seconds": round(begun["seconds"]),
        "asked": begun["asked"],
        "code": packed(code),
    }
    save(name, result)
    write_pages()


def begin(name: str, result: Result, folder: Path) -> Result:
    """Make the folder of a result, or find it; return what the code was when that was begun."""
    now = code_now()
    begun = {"code": now, "asked": asked(result), "seconds": 0.0}
    if (folder / BEGUN).is_file():
        earlier = json.loads((folder / BEGUN).read_text(encoding="utf-8"))
        same = all(earlier["code"].get(file) == now.get(file) for file in files_in(folder / READ))
        if same and earlier["asked"] == begun["asked"]:
            return earlier
        print(f"{name}: begins anew, what it depends on has changed", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "hook").mkdir(parents=True)
    (folder / "hook" / "sitecustomize.py").write_text(HOOK, encoding="utf-8")
    for part in {Path(file).parts[0] for file in [*now, *result.get("need", {}), "docs"]}:
        (folder / part).symlink_to(ROOT / part)
    (folder / BEGUN).write_text(json.dumps(begun), encoding="utf-8")
    return begun


def files_in(read: Path) -> set[str]:
    """Return the files of the repository in the list that was written while commands ran."""
    lines = read.read_text(encoding="utf-8").splitlines() if read.is_file() else []
    files = set()
    for line in lines:
        file = Path(importlib.util.source_from_cache(line) if line.endswith(".pyc") else line)
        if file.resolve().is_relative_to(ROOT):
            files.add(file.resolve().relative_to(ROOT).as_posix())
    return files


def processor() -> str:
    """Return the name of the processor, or of its kind."""
    said = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.*)", said.read_text()) if said.is_file() else None
    return model[1] if model else platform.machine()


def processor_seconds() -> float:
    """Return the processor time of the commands that have ended, and of what they left behind."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(SUBREAPER, 1)  # from now on: the servers that jobs are forked from
    with contextlib.suppress(ChildProcessError):
        for _ in range(50):
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                time.sleep(0.1)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def commit_of(files: list[str]) -> str:
    """Return the last commit of some files, marked where they differ from it."""
    log = ["git", "log", "-1", "--format=%h", "--", *files]
    last = subprocess.check_output(log, cwd=ROOT, text=True).strip()
    same = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *files], cwd=ROOT, check=False)
    return last + ("" if same.returncode == 0 else ", changed")


def save(name: str, result: Result) -> None:
    text = json.dumps(result, indent=1, ensure_ascii=False)
    file = ROOT / "benchmarks" / "results" / f"{name}.json"
    file.write_text(text + "\n", encoding="utf-8")


def where() -> dict[str, list[str]]:
    """Return the pages of each result: those with its marks, and those that show its figures."""
    texts = {
        page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in pages()
    }
    return {
        name: [
            page
            for page, text in texts.items()
            if name in {mark[1] for mark in MARK.findall(text)}
            or any(f"images/{Path(figure).name})" in text for figure in load(name)["figures"])
        ]
        for name in names()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--renew", nargs="+", metavar="NAME", help="measure again; all: stale ones")
    parser.add_argument("--write", action="store_true", help="write the pages from the files")
    options = parser.parse_args()
    if options.write:
        write_pages()
    elif options.renew:
        stale = [name for name in names() if reasons(load(name))[0] and not reasons(load(name))[1]]
        failed = []
        for name in stale if options.renew == ["all"] else options.renew:
            try:
                renew(name)
            except KeyboardInterrupt:
                raise SystemExit(f"{name}: ended; the same command goes on") from None
            except SystemExit as end:
                failed.append(str(end))
        if failed:
            raise SystemExit("\n".join(failed))
    else:
        for name, shown_on in where().items():
            result = load(name)
            why, why_not = reasons(result)
            cost = f"{result['seconds'] / 60:.1f} min" if "seconds" in result else "cost unknown"
            said = f"stale: {why}" if why else "fresh"
            said += f"; cannot be renewed here: {why_not}" if why_not else ""
            print(f"{name:24}{cost:>13}  {', '.join(shown_on)}: {said}")


if __name__ == "__main__":
    main()
