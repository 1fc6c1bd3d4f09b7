"""Measured tables and figures of README, docs and suites: are they of today's code?

    python benchmarks/results.py                      # list them
    python benchmarks/results.py --renew NAME ...     # measure again; `all`: whatever is stale
    python benchmarks/results.py --carry NAME ...     # the code changed, no number did; `all`, too
    python benchmarks/results.py --write              # put what the files say into the pages

A result is a file, `benchmarks/results/NAME.json`. By hand: its ``commands``, as a page prints
them, ``seeds`` in words, ``figures`` that they draw, patterns of data that C++ ``reads``, unseen by
Python, what they ``need`` that is not in the repository, with SHA-256, and ``gpu``: true, where
they need one. The rest is written by ``--renew``: the ``tables`` that they printed, versions,
machine, seconds of processor time, and the ``code``: a digest of each file of the repository that
was read (`digests.py`), and their last ``commit``. A result is stale when one of these has another
digest now. One without code is older than these files.

A page shows a table between `<!-- result NAME: TABLE -->` and `<!-- end -->`; TABLE is what its
command printed above it; `machines: all` says what all ran on. Within a sentence
`<!-- result NAME: TABLE | ROW | COLUMN -->` shows a cell, without its interval; such a mark does
not begin a line, where it would end the paragraph.

``--renew`` works in `outputs/results/NAME`, beside links to the repository. If it is ended, the
same command goes on there, unless code that was read has changed.

``--carry`` makes a stale result fresh without measuring it again. By hand, a result has ``short``:
its own commands at a small size, which print their numbers to the last bit, and no times. They run
in the last commit that has the stored digests, and here. Where they print the same, and read each
file that differs, the digests of today are written, and what was run: ``carried``. Times and films
cannot be carried: such results have no short commands.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import difflib
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
import tempfile
import time
from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from digests import digest, digest_of, git, packed, unpacked

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
    """Return a result, or end in a line that says which there are; `machines`: what they ran on."""
    if name == "machines":
        return {"tables": {"all": ran_on()}}
    file = ROOT / "benchmarks" / "results" / f"{name}.json"
    if not file.is_file():
        raise SystemExit(f"{name}: no such result; there are {', '.join(names())}")
    return json.loads(file.read_text(encoding="utf-8"))


def names() -> list[str]:
    return sorted(file.stem for file in (ROOT / "benchmarks" / "results").glob("*.json"))


def ran_on() -> list[str]:
    """Return a table: with which Python and torch the results ran, on what, of which commit."""
    ran: dict[str, list[str]] = {}
    for name in names():
        versions, machine = (result := load(name))["versions"], result["machine"]
        on = f"{versions['python']} | {versions['torch']} | {machine}"
        ran.setdefault(on, []).append(f"{name} ({result['commit']})")
    cells = {on: ", ".join(r) if len(r) < 5 else f"the other {len(r)}" for on, r in ran.items()}
    rows = [f"| {on} | {cells[on]} |" for on in sorted(ran, key=lambda on: len(ran[on]))]
    return ["| Python | torch | machine | results (commit) |", "|---|---|---|---|", *rows]


def pages() -> list[Path]:
    shown = ("README.md", "docs/**/*.md", "benchmarks/suites/*/README.md")
    return [page for pattern in shown for page in sorted(ROOT.glob(pattern))]


def code_now() -> dict[str, str]:
    """Return the digest of every file that may count: all of the repository but its texts."""
    files = git(ROOT, "ls-files", "--cached", "--others", "--exclude-standard")
    counted = (f for f in files if not f.startswith(("docs/", "benchmarks/results/")))
    return {f: digest(ROOT / f)[:8] for f in counted if f[-3:] != ".md" and (ROOT / f).is_file()}


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
    if old not in (None, asked(result)):
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
    from afm_rl.storage.files import write_whole  # others may be renewing beside us

    for page in pages():
        write_whole(page, filled(page).encode())


def renew(name: str) -> None:
    """Run the commands of a result in a folder of its own, or go on there; write file and pages."""
    digest.cache_clear()
    result = load(name)
    if reasons(result)[1]:
        raise SystemExit(f"{name}: cannot be renewed here: it {reasons(result)[1]}")
    folder = ROOT / "outputs" / "results" / name
    begun = begin(name, result, folder)
    start = processor_seconds()
    try:
        printed = run(name, result["commands"], folder)
    finally:
        begun["seconds"] += processor_seconds() - start
        (folder / BEGUN).write_text(json.dumps(begun), encoding="utf-8")
    digest.cache_clear()
    files = files_in(folder / READ, ROOT) | files_like(result, begun["code"])
    code = {file: value for file, value in begun["code"].items() if file in files}
    result.pop("carried", None)
    result |= {
        "figures": {file: digest(ROOT / file) for file in result["figures"]},
        "tables": tables_of(printed),
        "commit": commit_of([*code]),
        "versions": {"python": platform.python_version()}
        | {name: version(name) for name in ("afm-rl", "torch", "torchrl", "mujoco")},
        "machine": f"{processor()}, {os.cpu_count()} cores",
        "seconds": round(begun["seconds"]),
        "asked": begun["asked"],
        "code": packed(code),
    }
    save(name, result)
    write_pages()


def run(name: str, commands: list[str], folder: Path) -> str:
    """Return what commands print in the folder of a result."""
    settings = {"PYTHONPATH": f"{folder / 'hook'}", "RESULTS_READ": f"{folder / READ}"}
    settings |= {"AFM_RL_CACHE": f"{folder / 'cache'}", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    settings["PATH"] = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
    printed = ""
    try:
        for command in commands:
            print(f"{name}: {command}", flush=True)
            printed += subprocess.check_output(
                ["bash", "-c", command], cwd=folder, env=os.environ | settings, text=True
            )
    except subprocess.CalledProcessError as error:
        print(error.output[-2000:])
        raise SystemExit(f"{name}: ended with status {error.returncode}: {command}") from None
    return printed


def begin(name: str, result: Result, folder: Path) -> Result:
    """Make the folder of a result, or find it; return what the code was when that was begun."""
    now = code_now()
    begun = {"code": now, "asked": asked(result), "seconds": 0.0}
    if (folder / BEGUN).is_file():
        earlier = json.loads((folder / BEGUN).read_text(encoding="utf-8"))
        read = files_in(folder / READ, ROOT)
        same = all(earlier["code"].get(file) == now.get(file) for file in read)
        if same and earlier["asked"] == begun["asked"]:
            return earlier
        print(f"{name}: begins anew, what it depends on has changed", flush=True)
    make_folder(folder, result, ROOT)
    (folder / BEGUN).write_text(json.dumps(begun), encoding="utf-8")
    return begun


def make_folder(folder: Path, result: Result, checkout: Path) -> None:
    """Make the folder of a result anew, with links to a checkout, whose package is imported."""
    shutil.rmtree(folder, ignore_errors=True)
    lay_out(checkout, folder / "hook")
    (folder / "hook" / "sitecustomize.py").write_text(HOOK, encoding="utf-8")
    for name in {Path(file).parts[0] for file in [*code_now(), *result.get("need", {}), "docs"]}:
        at_hand = checkout if (checkout / name).exists() else ROOT
        (folder / name).symlink_to(at_hand / name)


def lay_out(checkout: Path, folder: Path) -> None:
    """Link the package of a checkout into a folder, as it is installed."""
    (folder / "afm_rl").mkdir(parents=True)
    for path in [*(checkout / "afm_rl").glob("*"), checkout / "envs", checkout / "conf"]:
        (folder / "afm_rl" / path.name).symlink_to(path)
    (folder / "examples").symlink_to(checkout / "examples")  # a wheel has its policies


def carry(name: str) -> None:
    """Write the digests of today, if short commands print what they did at the stored ones."""
    digest.cache_clear()
    result, now = load(name), code_now()
    why, why_not = reasons(result)
    code = unpacked(result.get("code", {}))
    changed = {file for file, value in code.items() if now.get(file) != value}
    if not changed or why_not or result.get("asked") != asked(result):
        raise SystemExit(f"{name}: nothing to carry over: {why_not or why or 'it is fresh'}")
    if not result.get("short"):
        raise SystemExit(f"{name}: cannot be carried over: it has no short commands")
    commit, read = commit_with(code), set[str]()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:  # servers end later
        checkout = Path(place, "checkout").resolve()
        git(ROOT, "archive", f"--output={place}/files.tar", commit)
        shutil.unpack_archive(f"{place}/files.tar", checkout)

        def printed(root: Path) -> list[str]:
            folder = Path(place, f"beside_{root.name}")
            make_folder(folder, result, root)
            lines = run(name, result["short"], folder).splitlines()
            read.update(files_in(folder / READ, root))
            return lines

        differing = [*difflib.unified_diff(printed(checkout), printed(ROOT), commit, "now", n=0)]
    if differing:
        raise SystemExit("\n".join([f"{name}: not carried over, it prints:", *differing[:20]]))
    if unread := sorted(changed - read):
        raise SystemExit(f"{name}: not carried over: no short command reads {', '.join(unread)}")
    files = read.union(code, files_like(result, now))
    code = {file: value for file, value in now.items() if file in files}
    step = {"from": commit, "to": commit_of([*code]), "short": result["short"]}
    save(name, result | {"code": packed(code), "carried": [*result.get("carried", []), step]})


def commit_with(code: dict[str, str]) -> str:
    """Return the last commit whose files have some digests."""
    for commit in git(ROOT, "rev-list", "HEAD"):
        entries = (line.split("\t") for line in git(ROOT, "ls-tree", "-r", commit))
        blobs = {file: entry.split()[-1] for entry, file in entries}
        if all(digest_in_git(blobs.get(file, ""), file)[:8] == code[file] for file in code):
            return commit[:7]
    raise SystemExit("nothing to carry over: no commit has the code that was measured")


@cache
def digest_in_git(blob: str, file: str) -> str:
    content = subprocess.check_output(["git", "cat-file", "blob", blob], cwd=ROOT) if blob else b""
    return digest_of(content, Path(file).suffix)


def files_like(result: Result, files: Iterable[str]) -> set[str]:
    """Return the files that C++ reads, unseen by Python."""
    return {f for pattern in result.get("reads", []) for f in fnmatch.filter(files, pattern)}


def files_in(read: Path, checkout: Path) -> set[str]:
    """Return the files of a checkout in the list that was written while commands ran."""
    lines = read.read_text(encoding="utf-8").splitlines() if read.is_file() else []
    files = set()
    for line in lines:
        file = Path(importlib.util.source_from_cache(line) if line.endswith(".pyc") else line)
        if file.resolve().is_relative_to(checkout):
            files.add(file.resolve().relative_to(checkout).as_posix())
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
    (last,) = git(ROOT, "log", "-1", "--format=%h", "--", *files)
    same = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *files], cwd=ROOT, check=False)
    return last + ("" if same.returncode == 0 else ", changed")


def save(name: str, result: Result) -> None:
    text = json.dumps(result, indent=1, ensure_ascii=False)
    file = ROOT / "benchmarks" / "results" / f"{name}.json"
    file.write_text(text + "\n", encoding="utf-8")


def where() -> dict[str, list[str]]:
    """Return the pages of each result: those with its marks, and those that show its figures."""
    texts = {f"{page.relative_to(ROOT)}": page.read_text(encoding="utf-8") for page in pages()}
    return {
        name: [
            page
            for page, text in texts.items()
            if name in {mark[1] for mark in MARK.findall(text)}
            or any(f"images/{Path(figure).name})" in text for figure in load(name)["figures"])
        ]
        for name in names()
    }


def each(act: Callable[[str], None], chosen: list[str]) -> None:
    """Renew or carry over the results of some names; `all`: those that are stale."""
    stale = [name for name in names() if reasons(load(name))[0] and not reasons(load(name))[1]]
    failed = []
    for name in stale if chosen == ["all"] else chosen:
        try:
            act(name)
        except KeyboardInterrupt:
            raise SystemExit(f"{name}: ended; the same command goes on") from None
        except SystemExit as end:
            failed.append(str(end))
    if failed:
        raise SystemExit("\n".join(failed))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--renew", nargs="+", metavar="NAME", help="measure again; all: stale ones")
    parser.add_argument("--carry", nargs="+", metavar="NAME", help="show that no number changed")
    parser.add_argument("--write", action="store_true", help="write the pages from the files")
    options = parser.parse_args()
    if options.write:
        write_pages()
    elif options.renew or options.carry:
        each(renew if options.renew else carry, options.renew or options.carry)
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
