"""Every source file is in a room, and a room grows only where another one shrinks."""

import json
import re
import subprocess

import pytest
import rooms
from harness import commit
from pages import ROOT


def budgets(envs, play, density=11.5, **why):
    rows = {"envs": {"budget": envs, **why}, "play": {"budget": play}, "core": {"end": 1}}
    return rows | {rooms.DENSITY: {"budget": density}}


def test_every_source_file_is_in_a_room():
    files = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).split()
    sources = [file for file in files if file.endswith((".py", *rooms.LANGUAGES))]
    assert {*map(rooms.room, sources)} <= {*json.loads((ROOT / rooms.BUDGETS).read_text())}
    with pytest.raises(SystemExit, match=r"tools/a\.py: in no room"):
        rooms.room("tools/a.py")


@pytest.mark.parametrize(
    ("sizes", "held", "said"),
    [
        ((100, 50, 11.5), budgets(100, 50), ""),
        ((101, 50, 11.5), budgets(100, 50), "envs: 101 code lines, its budget is 100: take 1 out"),
        ((100, 48, 11.5), budgets(100, 50), "play: 48 code lines, its budget is 50: lower it"),
        ((101, 49, 11.5), budgets(101, 49), "envs: .* is 101, and was 100: say `why`"),
        ((101, 50, 11.5), budgets(101, 50, why="a robot"), "all budgets: 151 .* were 150"),
        ((101, 49, 11.5), budgets(101, 49, why="a page of play left"), ""),
        ((100, 50, 11.4), budgets(100, 50), ""),
        ((100, 50, 11.6), budgets(100, 50), "tokens per code line: 11.6 tokens"),
    ],
)
def test_a_room_grows_only_where_another_one_shrinks(sizes, held, said):
    now = dict(zip(["envs", "play", rooms.DENSITY], sizes, strict=True))
    faults = rooms.faults(now, held, [budgets(100, 50), budgets(110, 50)])
    assert re.match(said, *faults) if said else not faults


def test_budgets_are_lowered_and_compared_with_those_of_all_commits(tmp_path):
    (tmp_path / "benchmarks").mkdir()
    for envs in (100, 90):
        (tmp_path / rooms.BUDGETS).write_text(json.dumps(budgets(envs, 50)))
        commit(tmp_path)
    assert rooms.load(tmp_path) == (budgets(90, 50), [budgets(100, 50)])
    rooms.lower(tmp_path, {"envs": 80, "play": 60, rooms.DENSITY: 11.6})
    assert rooms.load(tmp_path) == (budgets(80, 50), [budgets(90, 50), budgets(100, 50)])
