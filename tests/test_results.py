"""README, docs and suites show the measurements that the files of results hold."""

import json
import re
import runpy

import pandas as pd
import pytest
import results
from harness import commit
from pages import ROOT, SHOWN

table = runpy.run_path(str(ROOT / "benchmarks" / "missions.py"))["table"]

PROGRAM = """
import pathlib, sys
import used
count = pathlib.Path("outputs/count")
count.parent.mkdir(exist_ok=True)
count.write_text(str(int(count.read_text()) + 1 if count.exists() else 1))
if count.read_text() == "1":
    sys.exit(3)
print(f"errors:\\n\\n| | gain_0 |\\n|---|---|\\n| **a** | {used.x} [0, {count.read_text()}] |")
"""


def test_pages_show_what_the_files_of_results_hold():
    for page in SHOWN:
        text = page.read_text()
        assert results.filled(page) == text, page
        assert not re.search(r"^<!-- result [^>|]+\|", text, re.MULTILINE)  # ends the paragraph


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository with one result, whose second command fails at first."""
    monkeypatch.setattr(results, "ROOT", tmp_path)
    hand = {"commands": ["echo once >> outputs_of_first", "python examples/run.py"], "tables": {}}
    hand |= {"names": {"gain_0": "gain"}}
    files = {
        "examples/run.py": PROGRAM,
        "examples/used.py": "x = 1\n",
        ".gitignore": "outputs/\n__pycache__/\n",
        "README.md": "<!-- result one: errors -->\n<!-- end -->\n"
        "It is <!-- result one: errors | a | gain_0 --><!-- end -->.\n",
        "benchmarks/results/one.json": json.dumps(hand),
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    commit(tmp_path)
    return tmp_path


def test_a_renewal_resumes_fills_the_page_and_has_an_age(repository, capsys):
    with pytest.raises(SystemExit, match="one: ended with status 3: python examples/run.py"):
        results.renew("one")
    results.renew("one")
    folder = repository / "outputs" / "results" / "one"
    assert (folder / "outputs_of_first").read_text() == "once\n"  # not run again
    result = results.load("one")
    assert result["tables"]["errors"][-1] == "| **a** | 1 [0, 2] |"
    assert result["commit"] == results.git("rev-parse", "--short", "HEAD")
    page = (repository / "README.md").read_text()
    assert "| | gain |\n|---|---|\n| **a** | 1 [0, 2] |\n<!-- end -->" in page
    assert "It is <!-- result one: errors | a | gain_0 -->1<!-- end -->." in page

    assert results.age(result) == "0"
    (repository / "examples" / "used.py").write_text("x = 2\n")
    assert results.commit() == f"{result['commit']}, changed"
    commit(repository)
    assert results.age(result) == "1"
    results.show()
    assert re.search(r"^one +1 +0.0 ", capsys.readouterr().out, re.MULTILINE)


def test_a_renewal_starts_again_where_the_code_has_changed(repository):
    with pytest.raises(SystemExit, match="status 3"):
        results.renew("one")
    (repository / "examples" / "used.py").write_text("x = 2\n")
    with pytest.raises(SystemExit, match="status 3"):
        results.renew("one")


@pytest.mark.parametrize(
    ("given", "missing"),
    [({"need": {"data/a.xml": "0" * 64}}, "data/a.xml"), ({"gpu": True}, "a GPU")],
)
def test_what_needs_something_that_is_missing_cannot_be_renewed(
    repository, monkeypatch, given, missing
):
    monkeypatch.setattr(results.shutil, "which", lambda _: None)
    results.save("one", results.load("one") | given)
    with pytest.raises(SystemExit, match=f"one: cannot be measured here, .* needs {missing}"):
        results.renew("one")


@pytest.mark.parametrize(
    ("mark", "message"),
    [
        ("result two: errors", "two: no such result; there are one"),
        ("result one: other", "expected a table of errors"),
        ("result one: errors | b | mean", "expected a row and a column of that table"),
        ("result one: errors | a | median", "expected a row and a column of that table"),
    ],
)
def test_marks_without_a_result(repository, mark, message):
    tables = {"errors": ["| | mean |", "|---|---|", "| a | 1 |"]}
    results.save("one", results.load("one") | {"tables": tables})
    (repository / "README.md").write_text(f"<!-- {mark} --><!-- end -->")
    with pytest.raises(SystemExit, match=re.escape(message)):
        results.filled(repository / "README.md")


def test_a_table_of_missions():
    rows = [("a", "ring", 0, 1.0), ("a", "ring", 1, 2.0), ("b", "ring", 0, 4.0)]
    missions = pd.DataFrame(rows, columns=["method", "track", "seed", "steps"])
    missions = missions.assign(scenario="ring", share=0.25)
    shown = table(missions, ["track"], ["method"], ["steps:1", "share:2"])
    assert shown.to_dict("records") == [
        {"track": "ring", "a": "1.5 [1.0, 2.0] / 0.25", "b": "4.0 / 0.25"}
    ]
    assert table(missions, ["method"], [], ["steps:0"])["steps"].tolist() == ["2 [1, 2]", "4"]
