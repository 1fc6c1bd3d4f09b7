"""Rooms of the repository, their sizes, and the budgets that these may not exceed.

Every source file is in one room. The size of a room are its code lines: no docstrings, comments or
blank lines; that of a room of settings are its files. `budgets.json` says the ``budget`` of each
room, what it was ``before`` there were budgets, where it was to be at the ``end``, and, if it rose,
``why``: what left another room for it.
"""

from __future__ import annotations

import ast
import io
import json
import re
import tokenize
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

from digests import git

BUDGETS = "benchmarks/budgets.json"
LANGUAGES = {"ipynb": "notebooks", "pyi": "stubs", "sh": "shell", "yaml": "other YAML"}
LANGUAGES |= dict.fromkeys(("c", "cpp", "h"), "C") | dict.fromkeys(("css", "html", "js"), "pages")
COMMENTS = {"html": r"<!--[\s\S]*?-->", "sh": r"^\s*#.*"}
SLASHES = r"/\*[\s\S]*?\*/|^\s*//.*"  # of the other languages
SPACE = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
DENSITY = "tokens per code line"  # of afm_rl and envs
UNITS = {"conf": "files", "other YAML": "files", DENSITY: "tokens"}  # the others: code lines
Budgets = dict[str, dict[str, Any]]


class Source(NamedTuple):
    """A source file: its room, its code lines and, if it is of Python, their tokens."""

    room: str
    lines: int
    tokens: int


def room(file: str) -> str | None:
    """Return the room of a source file; None for data, texts and settings of tools.

    >>> room("afm_rl/dynamics/known.py"), room("afm_rl/play/page.js"), room("README.md")
    ('dynamics', 'pages', None)
    """
    language = file.rpartition(".")[2]
    if language in LANGUAGES:
        return "conf" if file.startswith("conf/") else LANGUAGES[language]
    if language != "py":
        return None
    top, *inner = file.split("/")
    if top == "afm_rl":
        return inner[0] if inner[1:] else "root files"
    if top in ("benchmarks", "envs", "examples", "tests"):
        return top
    if file.startswith(("conf/", "docs/theme/", "setup.py")):
        return "site and set-up"
    raise SystemExit(f"{file}: in no room; expected one of those in benchmarks/rooms.py")


def size(text: str, language: str) -> tuple[int, int]:
    r"""Return how many code lines a text has, and how many tokens, if it is of Python.

    >>> size("x = [\n    1,  # one\n\n]\n'Of x.'\n", "py"), size("/* a\n */\nb() // c\n", "js")
    ((3, 6), (1, 0))
    """
    if language == "ipynb":
        cells = [c["source"] for c in json.loads(text)["cells"] if c["cell_type"] == "code"]
        return size("".join(x for cell in cells for x in [*cell, "\n"] if x[0] not in "%!"), "py")
    if language not in ("py", "pyi"):
        code = re.sub(COMMENTS.get(language, SLASHES), "", text, flags=re.MULTILINE)
        return sum(bool(line.strip()) for line in code.splitlines()), 0
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str):
            docstrings |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    tokens = [
        token
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in {*SPACE, tokenize.COMMENT} and token.start[0] not in docstrings
    ]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    return len(lines), len(tokens)


def sources(root: Path) -> dict[str, Source]:
    """Return the source files that git tracks."""
    rooms = {file: room(file) for file in git(root, "ls-files")}
    return {
        file: Source(name, *size((root / file).read_text(encoding="utf-8"), file.split(".")[-1]))
        for file, name in rooms.items()
        if name and (root / file).is_file()
    }


def sizes(files: dict[str, Source]) -> dict[str, float]:
    """Return the size of each room, and how dense the code is."""
    rooms: Counter[str] = Counter()
    for source in files.values():
        rooms[source.room] += 1 if UNITS.get(source.room) == "files" else source.lines
    library = [files[f] for f in files if re.match(r"(afm_rl|envs)/.*\.py$", f)]
    density = sum(source.tokens for source in library) / sum(source.lines for source in library)
    return {**dict(sorted(rooms.items())), DENSITY: round(density, 2)}


def faults(now: dict[str, float], budgets: Budgets, earlier: list[Budgets]) -> list[str]:
    """Return what is wrong with sizes and budgets, a sentence each.

    Args:
        now: The size of each room.
        budgets: Those that hold.
        earlier: Those that held, the newest first.
    """
    said = []
    for name in sorted({*now, *budgets}):
        unit, count, row = UNITS.get(name, "code lines"), now.get(name, 0), budgets.get(name, {})
        budget, last = row.get("budget", 0), earlier[0].get(name, {}) if earlier else row
        about = f"{name}: {count:,} {unit}, its budget is {budget:,}"
        if count > budget:
            said.append(f"{about}: take {count - budget:,.4g} out, here or in another room")
        elif count < budget and unit != "tokens":
            said.append(f"{about}: lower it in this commit: python benchmarks/house.py --write")
        if budget > last.get("budget", 0) and row.get("why") in (None, last.get("why")):
            said.append(f"{about}, and was {last.get('budget', 0):,}: say `why`: what left, where?")
    for unit in ("code lines", "files"):
        least = min((total(those, unit) for those in earlier), default=total(budgets, unit))
        if total(budgets, unit) > least:
            said.append(f"all budgets: {total(budgets, unit):,} {unit}, but they were {least:,}")
    return said


def total(budgets: Budgets, unit: str) -> int:
    """Return the sum of the budgets that have a unit."""
    rows = [row for name, row in budgets.items() if UNITS.get(name, "code lines") == unit]
    return sum(row.get("budget", 0) for row in rows)


def load(root: Path) -> tuple[Budgets, list[Budgets]]:
    """Return the budgets, and other ones that commits had before, the newest first."""
    budgets = json.loads((root / BUDGETS).read_text(encoding="utf-8"))
    commits = git(root, "rev-list", "HEAD", "--", BUDGETS)
    earlier = [json.loads("".join(git(root, "show", f"{c}:{BUDGETS}"))) for c in commits]
    return budgets, earlier[earlier[:1] == [budgets] :]


def lower(root: Path, now: dict[str, float]) -> None:
    """Write budgets that are no larger than what there is."""
    budgets = json.loads((root / BUDGETS).read_text(encoding="utf-8"))
    for name, row in budgets.items():
        if "budget" in row and name != DENSITY:  # which rises where sparse lines leave
            row["budget"] = min(row["budget"], now.get(name, 0))
    text = json.dumps(budgets, indent=1, ensure_ascii=False)
    (root / BUDGETS).write_text(text + "\n", encoding="utf-8")
