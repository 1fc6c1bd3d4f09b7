"""What README, docs and suites show of measurements is what the files of results say."""

import json
import re
import runpy
import shutil
from pathlib import Path

import digests
import pandas as pd
import pytest
import results
from harness import commit
from pages import ROOT, SHOWN, name_of

table = runpy.run_path(str(ROOT / "benchmarks" / "missions.py"))["table"]

NUMBER = re.compile(r"^[\s*~<>≤±+-]*[.\d][\d.,]*")
NOT_MEASURED = {  # tables of numbers outside marks: page, head: why
    ("README.md", "| | needs | tested with |"): "test_docs.py compares it",
    ("quickstart.md", "| column of `steps.parquet` | what it says |"): "what 0 and 1 mean",
}
SHOWN_ALONE = {  # figures of no result: why
    "layers.svg": "drawn from the imports whenever the site is built",
    "play.png": "a page of ours, as it looks",
    "diagnosis.png": "a page of ours, as it looks",
    "try.webp": "a page of ours, as it moves",
}


def outside(page):
    """Return the tables of a page, without code, that stand outside marks."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"(?:^\|.*\n)+", results.MARK.sub("", text), re.MULTILINE)


def is_of_numbers(table):
    """Return whether a fifth of the cells, without heads of rows and columns, begin as numbers."""
    cells = [c for line in table.splitlines()[2:] for c in line.strip("|").split("|")[1:]]
    return sum(bool(NUMBER.match(cell)) for cell in cells) * 5 > len(cells)


@pytest.mark.parametrize("page", SHOWN, ids=name_of)
def test_a_page_shows_what_the_files_of_results_say(page):
    text = page.read_text()
    assert results.filled(page) == text
    assert not re.search(r"^<!-- result [^>|]+\|", text, re.MULTILINE)  # ends the paragraph


def test_every_table_of_numbers_is_of_a_result():
    heads = {
        (name_of(page), table.splitlines()[0])
        for page in SHOWN
        for table in outside(page)
        if is_of_numbers(table)
    }
    assert heads == set(NOT_MEASURED)


def test_every_figure_is_of_a_result():
    figures = {file for name in results.names() for file in results.load(name)["figures"]}
    shown = {
        image
        for page in SHOWN
        for image in re.findall(r"!\[[^]]*\]\(\S*?images/(\S+)\)", page.read_text())
    }
    assert {f"docs/images/{image}" for image in shown - set(SHOWN_ALONE)} == figures


def test_every_result_is_shown_and_its_figures_are_those_of_its_file():
    for name, shown_on in results.where().items():
        assert shown_on, name
        for file, digest in results.load(name)["figures"].items():
            assert results.digest(ROOT / file) == digest, file


@pytest.mark.parametrize(
    ("file", "old", "new", "same"),
    [
        ("a.py", '"""A."""\nx = 1  # one\n', "x = (1)\n", True),
        ("a.py", "def f():\n    '''F.'''\n", "def f():\n    pass\n", True),
        ("a.py", "x = 1\n", "x = 2\n", False),
        ("a.yaml", "x: 1 # one\n", "x: 1\n", True),
        ("a.yaml", "x: 1\n", "x: 2\n", False),
        ("a.csv", "x\n1\n", "x\n1\n\n", False),
    ],
)
def test_what_tells_files_apart(file, old, new, same):
    old, new = (digests.digest_of(text.encode(), Path(file).suffix) for text in (old, new))
    assert (old == new) is same


def is_a_matter_of_taste(code):
    """Return whether `@` of a program can be `a` or `b`, and no digest says which."""
    texts = (code.replace("@", name).encode() for name in "ab")
    return len({digests.digest_of(text, ".py") for text in texts}) == 1


@pytest.mark.parametrize(
    "code",
    [
        "def f(x):\n for @ in x: x.y[@] = @",
        "def f(x):\n @: int = 1\n def g():\n  nonlocal @\n  @ += 1\n return lambda a: a, @",
        "def f(x):\n class C:\n  def g(self): return @\n @ = 1",
        "def f(x):\n try: f(x)\n except E as @: return @\n with f(x) as @: return @",
        "def f(x):\n match x:\n  case {'x': @, **y} | C(x=@, y=y): return @, y",
        "def f(x): return [y for y in x], {@: y for @, y in x if (z := @)}, z",
        "def f(x): return {y: z for y, z in x if (@ := y)}, @",
        "x = [@ for @ in x]",
    ],
)
def test_a_local_variable_may_have_another_name(code):
    assert is_a_matter_of_taste(code)


@pytest.mark.parametrize(
    "code",
    [
        "@ = 1",
        "def f(@): return @",
        "x = lambda @: @",
        "f(@=1)",
        "class C:\n @ = 1",
        "def f(x): x.@ = 1",
        "def f():\n import @\n def g(): return @",
        "def f():\n def @(): pass\n return @",
        "def f():\n global @\n @ = 1",
        "def f():\n @ = 1\n return locals()",
        "def f():\n @ = 1\n return f'{@=}'",
        "def f(a):\n x = [@ for a in f(a)]",
        "def f():\n a, b = 1, 2\n return @",
        "def f():\n a, x = 1, 2\n class C:\n  a = 3\n  def g(self): return @",
    ],
)
def test_what_others_can_say_or_see_may_not(code):
    assert not is_a_matter_of_taste(code)


def test_a_file_has_one_digest_in_all_versions_of_python():
    text = b"def f(x: int = 1) -> str:\n    y = x\n    return f\"{y!r:>4} {'a'}\"\n"
    assert digests.digest_of(text, ".py")[:8] == "67784549"


def test_a_table_of_missions():
    rows = [("a", "ring", 0, 1.0), ("a", "ring", 1, 2.0), ("b", "ring", 0, 4.0)]
    missions = pd.DataFrame(rows, columns=["method", "track", "seed", "steps"])
    missions = missions.assign(scenario="ring", share=0.25)
    shown = table(missions, ["track"], ["method"], ["steps:1", "share:2"])
    assert shown.to_dict("records") == [
        {"track": "ring", "a": "1.5 [1.0, 2.0] / 0.25", "b": "4.0 / 0.25"}
    ]
    assert table(missions, ["method"], [], ["steps:0"])["steps"].tolist() == ["2 [1, 2]", "4"]


def begun(folder):
    """Make a repository with one result, whose command forks, and ends at first."""
    program = """
        import os, pathlib, sys
        import used
        if not os.fork():
            import forked
            os._exit(0)
        os.wait()
        open("conf.yaml").read()
        done = pathlib.Path("outputs", "done")
        done.parent.mkdir(exist_ok=True)
        parts = int(done.read_text()) if done.exists() else 0
        done.write_text(str(parts + 1))
        if not parts:
            sys.exit(3)
        print(f"errors:\\n\\n| | mean |\\n|---|---|\\n| **a** | {used.x} [1, {parts}] |")
    """
    files = {
        "run.py": re.sub("^ {8}", "", program, flags=re.MULTILINE),
        "used.py": '"""Used."""\nx = 1\n',
        "forked.py": "",
        "unused.py": "",
        "conf.yaml": "x: 1\n",
        ".gitignore": "outputs/\n",
        "README.md": "<!-- result one: errors -->\n<!-- end -->\n"
        "It is <!-- result one: errors | a | mean --><!-- end -->.\n",
        "benchmarks/results/one.json": json.dumps(
            {"commands": ["python run.py"], "seeds": "none", "figures": {}, "tables": {}}
        ),
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    commit(folder)
    return folder


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """Work in such a repository."""
    monkeypatch.setattr(results, "ROOT", tmp_path)
    return begun(tmp_path)


def change(file, text):
    file.write_text(text)
    results.digest.cache_clear()


def test_renewing_goes_on_notes_what_was_read_and_writes_the_page(desk):
    assert results.reasons(results.load("one")) == ("never renewed, of no commit", "")
    with pytest.raises(SystemExit, match="one: ended with status 3: python run.py"):
        results.renew("one")
    results.renew("one")
    result = results.load("one")
    assert set(results.unpacked(result["code"])) == {"run.py", "used.py", "forked.py", "conf.yaml"}
    assert result["tables"] == {"errors": ["| | mean |", "|---|---|", "| **a** | 1 [1, 1] |"]}
    page = (desk / "README.md").read_text()
    assert "| **a** | 1 [1, 1] |\n<!-- end -->" in page and "mean -->1<!-- end -->." in page
    assert results.reasons(result) == ("", "")
    change(desk / "unused.py", "x = 2")
    change(desk / "used.py", '"""It is used."""\nx = 1  # one\n')
    assert results.reasons(result) == ("", "")
    change(desk / "used.py", "x = 2\n")
    assert results.reasons(result) == ("used.py changed", "")
    with pytest.raises(SystemExit, match="status 3"):  # begins anew
        results.renew("one")


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """A repository whose result is fresh, and in a commit."""
    desk = begun(tmp_path_factory.mktemp("fresh"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results, "ROOT", desk)
        results.save("one", results.load("one") | {"short": ["python run.py || python run.py"]})
        with pytest.raises(SystemExit, match="status 3"):
            results.renew("one")
        results.renew("one")
    commit(desk)
    return desk


@pytest.fixture
def measured(fresh, tmp_path, monkeypatch):
    """A copy of it."""
    copy = shutil.copytree(fresh, tmp_path / "desk", symlinks=True)
    monkeypatch.setattr(results, "ROOT", copy)
    results.digest.cache_clear()
    return copy


def test_a_result_is_carried_over_where_its_short_commands_print_the_same(measured):
    before = results.load("one")
    change(measured / "used.py", "y = 1\nx = y\n")
    (measured / "forked.py").rename(measured / "moved.py")
    change(measured / "run.py", (measured / "run.py").read_text().replace("forked", "moved"))
    results.carry("one")
    after = results.load("one")
    assert results.reasons(after) == ("", "") and after["tables"] == before["tables"]
    assert set(results.unpacked(after["code"])) == {"run.py", "used.py", "moved.py", "conf.yaml"}
    (carried,) = after["carried"]
    assert carried["from"] == digests.git(measured, "rev-parse", "HEAD")[0][:7]
    assert carried["short"] == before["short"]
    with pytest.raises(SystemExit, match="one: nothing to carry over: it is fresh"):
        results.carry("one")


@pytest.mark.parametrize(
    ("short", "said"),
    [
        (["python run.py || python run.py"], r"one: .*\n-\| \*\*a\*\* \| 1 .*\n\+.* \| 2 "),
        (["echo 1"], "one: not carried over: no short command reads used.py"),
        ([], "one: cannot be carried over: it has no short commands"),
    ],
)
def test_what_may_have_changed_is_not_carried_over(measured, short, said):
    results.save("one", results.load("one") | {"short": short})
    change(measured / "used.py", "x = 2\n")
    with pytest.raises(SystemExit, match=re.compile(said, re.DOTALL)):
        results.carry("one")
    assert results.reasons(results.load("one")) == ("used.py changed", "")


@pytest.mark.parametrize(
    ("given", "said"),
    [({"need": {"data/a.xml": "0" * 64}}, "data/a.xml"), ({"gpu": True}, "a GPU")],
)
def test_what_needs_something_that_is_missing_cannot_be_renewed(desk, monkeypatch, given, said):
    monkeypatch.setattr(results.shutil, "which", lambda _: None)
    results.save("one", results.load("one") | given)
    with pytest.raises(SystemExit, match=f"one: cannot be renewed here: it needs {said}"):
        results.renew("one")


def test_a_page_has_names_of_its_own(desk):
    tables = {"errors": ["| | gain_0 |", "|---|---|", "| gain_0 = -1 | gain_0 |"]}
    names = {"gain_0": "gain", "gain_0 = -1": "reversed"}
    results.save("one", results.load("one") | {"tables": tables, "names": names})
    (desk / "README.md").write_text("<!-- result one: errors --><!-- end -->")
    assert "| | gain |\n|---|---|\n| reversed | gain_0 |\n" in results.filled(desk / "README.md")


@pytest.mark.parametrize(
    ("mark", "said"),
    [
        ("result two: errors", "two: no such result; there are one"),
        ("result one: other", "expected a table of errors"),
        ("result one: errors | b | mean", "expected a row and a column of that table"),
        ("result one: errors | a | median", "expected a row and a column of that table"),
    ],
)
def test_marks_that_say_nothing(desk, mark, said):
    tables = {"errors": ["| | mean |", "|---|---|", "| a | 1 |"]}
    results.save("one", results.load("one") | {"tables": tables})
    (desk / "README.md").write_text(f"<!-- {mark} --><!-- end -->")
    with pytest.raises(SystemExit, match=re.escape(said)):
        results.filled(desk / "README.md")
