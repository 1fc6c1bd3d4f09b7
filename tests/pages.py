"""What README, docs and suites print: code, files and commands."""

import json
import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
SHOWN = [*PAGES, *sorted((ROOT / "benchmarks" / "suites").glob("*/README.md"))]
FENCE = re.compile(r"^```(python|yaml|sh|bash|xml)\n(.*?)^```", re.MULTILINE | re.DOTALL)
OTHER_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"(?:# @.*\n)?(?:# |<!-- )(\S+\.(?:py|yaml|xml))(?:: .*| -->)?\n")
INLINE = re.compile(r"`((?:afm-rl|python|make|pip|pytest)[\w-]* [^`]+)`")
PLACEHOLDER = re.compile(r"\b(?!GET|AFM)[A-Z]{3,}\b")  # afm-rl-report FOLDER


class Command(NamedTuple):
    """A command line that a page prints."""

    page: Path
    words: tuple[str, ...]


def name_of(page):
    return str(page.relative_to(ROOT)).removeprefix("docs/")


def blocks(page, *kinds):
    return [text for found, text in FENCE.findall(page.read_text()) if found in kinds]


def write_files(page, folder):
    """Write the blocks that are files; return the other Python blocks."""
    rest = []
    for kind in ("python", "yaml", "xml"):
        for text in blocks(page, kind):
            named = NAME.match(text)
            if named:
                path = folder / named[1]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)  # as a reader pastes it
            elif kind == "python":
                rest.append(text)
    return rest


def commands():
    """Find each distinct command, without what stands for something else.

    Those that a page prints, and those that renew its numbers.
    """
    found = {}
    for page in [*SHOWN, *sorted((ROOT / "benchmarks" / "results").glob("*.json"))]:
        if page.suffix == ".json":
            lines = json.loads(page.read_text())["commands"]
        else:
            prose = re.sub(OTHER_FENCE, "", page.read_text())
            lines = [line.replace("\n", " ") for line in INLINE.findall(prose)]
        for block in blocks(page, "sh", "bash"):
            lines += block.replace("\\\n", " ").splitlines()
        for line in lines:
            words = shlex.split(line, comments=True)
            while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):  # of the environment
                words.pop(0)
            if not words or any(PLACEHOLDER.search(word) for word in words):
                continue
            words[0] = words[0].removeprefix(".venv/bin/")
            words = [word for word in words if not re.match(r"hydra\.\w+\.dir=", word)]
            found.setdefault(tuple(words), Command(page, tuple(words)))
    return list(found.values())
