"""What the README shows works; the page of the command line names every choice."""

import re
import shlex
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser

import afm_rl.conf
from afm_rl.missions import build

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
CONF = Path(afm_rl.conf.__file__).parent
GROUPS = {path.name: {p.stem for p in path.glob("*.yaml")} for path in CONF.iterdir()}
GROUPS = {group: choices for group, choices in GROUPS.items() if choices}
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def rows():
    """Read the tables of choices: the names in the first column of each group's table."""
    found, group = {}, None
    for line in (ROOT / "docs" / "command_line.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            group = None
        elif group is None:
            group = cells[0] if cells[0] != "model" else "dynamics"
        elif group in GROUPS:
            found.setdefault(group, []).extend(re.findall(r"`(\w+)`", cells[0]))
    return found


def commands():
    """Find the README's command lines, each as a list of overrides."""
    texts = re.findall(r"^(?:\S*/)?afm-rl (.+)$", README, re.MULTILINE)
    texts += re.findall(r"`afm-rl ([^`]+)`", README)
    split = (shlex.split(text, comments=True) for text in texts)
    return [[part for part in parts if not part.startswith("-")] for parts in split]


def test_there_is_something_to_check():
    assert BLOCKS and len(commands()) > 5
    assert rows().keys() == GROUPS.keys()


@pytest.mark.parametrize("code", BLOCKS)
def test_python_blocks_run_by_themselves(code, short_trainings, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {"__name__": "readme"})


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_every_choice_is_explained_once(group):
    assert sorted(rows()[group]) == sorted(GROUPS[group])


@pytest.mark.parametrize("overrides", commands(), ids=" ".join)
def test_command_lines_can_be_run(overrides, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("my_track.csv").write_text("x,y\n0,0\n4,0\n4,4\n")
    parsed = OverridesParser.create().parse_overrides(overrides)
    first = [
        f"{each.get_key_element()}={next(iter(each.sweep_string_iterator()))}"
        if each.is_sweep_override()
        else each.input_line
        for each in parsed
    ]
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        build(compose("config", first))


def test_files_that_are_linked_exist():
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
