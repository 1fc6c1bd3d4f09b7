"""What the pages for users show works: files, snippets and commands, from top to bottom."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_module

from afm_rl.cli.trusted import checked
from afm_rl.missions import build

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [
    *(DOCS / "quickstart.md", DOCS / "torchrl.md", DOCS / "reliability.md"),
    *(DOCS / "command_line.md", DOCS / "concepts.md", DOCS / "design.md", DOCS / "benchmarks.md"),
    *sorted((DOCS / "howto").glob("*.md")),
    *sorted((DOCS / "methods").glob("*.md")),
]
FENCE = re.compile(r"^```(python|yaml|sh|xml)\n(.*?)^```", re.MULTILINE | re.DOTALL)
NAME = re.compile(r"(?:# @.*\n)?(?:# |<!-- )(\S+\.(?:py|yaml|xml))(?:: .*| -->)?\n")
PATHS = re.compile(r"`((?:afm_rl|envs|conf|examples|notebooks|tests|benchmarks)/[\w./]+)`")


def name_of(page):
    return str(page.relative_to(DOCS))


def blocks(page, kind):
    return [text for found, text in FENCE.findall(page.read_text()) if found == kind]


def commands():
    """Find the command lines of all pages that start one run."""
    found = []
    for page in PAGES:
        inline = re.findall(r"`(afm-rl [^`]+)`", re.sub(FENCE, "", page.read_text()))
        for line in [*"".join(blocks(page, "sh")).splitlines(), *inline]:
            words = shlex.split(line, comments=True)
            while words and re.fullmatch(r"[A-Z]+=\S*", words[0]):  # of the environment
                words.pop(0)
            asked = words[1:]
            if words[:1] == ["afm-rl"] and "=" in line and not {"-m", "--cfg"} & set(asked):
                found.append(pytest.param(page, asked, id=f"{name_of(page)}: {' '.join(asked)}"))
    return found


@pytest.fixture
def desk(monkeypatch, tmp_path):
    """Work in a folder with the examples alone, from which modules are imported."""
    monkeypatch.chdir(tmp_path)
    for name in ("examples", "benchmarks"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("mine", None)


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


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "page", [p for p in sorted(DOCS.rglob("*.md")) if blocks(p, "python")], ids=name_of
)
def test_snippets_run(page, desk):
    rest = write_files(page, desk)
    exec(compile("\n".join(rest), str(page), "exec"), {"__name__": "page"})


@pytest.mark.parametrize(("page", "asked"), commands())
def test_commands_can_be_run(page, asked, desk):
    write_files(page, desk)
    with checked(asked) as names, initialize_config_module("afm_rl.conf", version_base="1.3"):
        agent = build(compose("config", asked), names)
    assert len(agent.missions)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_pages_are_short_and_what_they_name_exists(page):
    text = page.read_text()
    links = [link for link in re.findall(r"\]\(([^)#:]+)", text) if not link.startswith("http")]
    made = ("api.md", "images/layers.svg")  # when the site is built
    links = [link for link in links if not link.endswith(made)]
    assert [link for link in links if not (page.parent / link).exists()] == []
    assert [path for path in PATHS.findall(text) if not (ROOT / path).exists()] == []
    if page.parent.name == "methods":
        assert text.count("\n") <= 60


def test_the_design_page_names_what_is_there():
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    named = re.findall(r"`([\w.]+)`(?:, | in )`((?:afm_rl|envs)/[\w/]+\.py)`", page)
    assert len(named) >= 15
    for name, path in named:
        code = (ROOT / path).read_text(encoding="utf-8")
        for part in name.split("."):
            assert re.search(rf"(def|class) {part}\b", code), (name, path)


def test_every_page_is_in_the_navigation():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]

    def leaves(entry):
        if isinstance(entry, str):
            return {entry}
        return set().union(*map(leaves, entry.values() if isinstance(entry, dict) else entry))

    pages = {name_of(page) for page in DOCS.rglob("*.md")}
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert leaves(nav) >= pages | notebooks | {"index.md", "api.md"}


def test_docstrings_become_markdown(monkeypatch):
    pytest.importorskip("griffe")
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    import docstrings

    text = "See :class:`~afm_rl.Flow`, :math:`a^0`.\n\n.. math:: a,\n  b\n\n>>> 1\n1\n\nEnd"
    found = docstrings.as_markdown(text)
    assert found.startswith("See `Flow`, $a^0$.") and found.endswith("End")
    assert "$$\na,\nb\n$$" in found and "```pycon\n>>> 1\n1\n```" in found


@pytest.fixture
def hooks(monkeypatch):
    pytest.importorskip("latex2mathml")
    pytest.importorskip("nbconvert")
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    import hooks

    return hooks


def test_formulas_become_mathml(hooks):
    page = '<p><span class="arithmatex">\\(a &lt; b\\)</span></p>'
    assert re.search("<math .*<mo>&#x0003C;</mo>.*</math></p>$", hooks.on_page_content(page, None))


def test_links_of_the_readme_lead_to_pages_or_are_text(hooks):
    text = "[a](docs/afm.md#x) [b](notebooks/n.ipynb) [c](LICENSE) ![d](docs/images/e.png)"
    expected = "[a](afm.md#x) [b](notebooks/n.md) c ![d](images/e.png)"
    assert hooks.with_site_links(text) == expected


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_notebooks_hold_pictures_and_stay_small(path):
    cells = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not any(output["output_type"] == "error" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.get("name") == "stderr" for output in outputs)  # paths of a machine
    assert path.stat().st_size < 500_000


def test_imports_point_downwards(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "theme"))
    import layers

    upwards = {
        pair: paths
        for pair, paths in layers.imports().items()
        if layers.floor_of(pair[0]) >= layers.floor_of(pair[1])
    }
    assert upwards == {}
    # environments are found by name: only the command line and the page import them
    assert {here for here, there in layers.imports() if there == "envs"} <= {"cli", "play"}
    assert layers.draw().count("<rect") == sum(map(len, layers.FLOORS))
