"""Pages lead to what is there, and the site is made of them."""

import json
import re
import subprocess
import sys
import tomllib

import pytest
import yaml
from packaging.specifiers import SpecifierSet
from pages import DOCS, PAGES, ROOT, SHOWN, name_of

from afm_rl.transforms.loop_options import LoopOptions

pytestmark = pytest.mark.check
sys.path.append(str(DOCS / "theme"))
CODE = re.compile(r"`([\w.]+)`(?:, | in )`((?:afm_rl|envs)/[\w/]+\.py)`")
PATHS = re.compile(r"`((?:afm_rl|envs|conf|examples|notebooks|tests|benchmarks)/[\w./]+)`")


@pytest.mark.parametrize("page", SHOWN, ids=name_of)
def test_what_pages_name_exists(page):
    text = page.read_text()
    links = [link for link in re.findall(r"\]\(([^)#:]+)", text) if not link.startswith("http")]
    made = ("api.md", "images/layers.svg")  # when the site is built
    links = [link for link in links if not link.endswith(made)]
    assert [link for link in links if not (page.parent / link).exists()] == []
    assert [path for path in PATHS.findall(text) if not (ROOT / path).exists()] == []
    for name, path in CODE.findall(text):
        code = (ROOT / path).read_text(encoding="utf-8")
        assert all(re.search(rf"(def|class) {part}\b", code) for part in name.split(".")), name


def test_the_page_of_a_policy_has_all_arguments():
    import arguments

    assert arguments.page() == arguments.PAGE.read_text(), "run `make format`"
    assert all(
        f"`{name}=" in arguments.page() for name in (*LoopOptions.__annotations__, "max_delay")
    )


def test_every_page_is_in_the_navigation():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]

    def leaves(entry):
        if isinstance(entry, str):
            return {entry}
        return set().union(*map(leaves, entry.values() if isinstance(entry, dict) else entry))

    pages = {name_of(page) for page in PAGES} - {"README.md"}
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert leaves(nav) >= pages | notebooks | {"index.md", "api.md"}


def explained(groups):
    """Read the tables of choices: the names in the first column of each group's table."""
    found, group = {}, None
    for line in (DOCS / "command_line.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            group = None
        elif group is None:
            group = cells[0] if cells[0] != "model" else "dynamics"
        elif group in groups:
            found.setdefault(group, []).extend(re.findall(r"`(\w+)`", cells[0]))
    return found


def test_every_choice_of_help_is_explained_once_and_every_command():
    said = subprocess.check_output([sys.executable, "-m", "afm_rl", "--help"], text=True)
    choices = dict(re.findall(r"^(\w+): (.*)$", said, re.MULTILINE))
    found = {group: ", ".join(sorted(names)) for group, names in explained(choices).items()}
    assert found == choices and len(choices) > 8
    commands = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    page = (DOCS / "command_line.md").read_text()
    assert {*re.findall(r"`(afm-rl[\w-]*) ", page)} == {*commands}


def test_docstrings_become_markdown():
    pytest.importorskip("griffe")
    import docstrings

    text = "See :class:`~afm_rl.Flow`, :math:`a^0`.\n\n.. math:: a,\n  b\n\n>>> 1\n1\n\nEnd"
    found = docstrings.as_markdown(text)
    assert found.startswith("See `Flow`, $a^0$.") and found.endswith("End")
    assert "$$\na,\nb\n$$" in found and "```pycon\n>>> 1\n1\n```" in found


@pytest.fixture
def hooks():
    pytest.importorskip("latex2mathml")
    pytest.importorskip("nbconvert")
    import hooks

    return hooks


def test_formulas_become_mathml(hooks):
    page = '<p><span class="arithmatex">\\(a &lt; b\\)</span></p>'
    assert re.search("<math .*<mo>&#x0003C;</mo>.*</math></p>$", hooks.on_page_content(page, None))


def test_links_of_the_readme_lead_to_pages_or_are_text(hooks):
    text = "[a](docs/afm.md#x) [b](notebooks/n.ipynb) [c](LICENSE) ![d](docs/images/e.png)"
    expected = "[a](afm.md#x) [b](notebooks/n.md) c ![d](images/e.png)"
    assert hooks.with_site_links(text) == expected


def test_the_front_page_says_which_versions():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {"Python": project["requires-python"]}
    for line in (*project["dependencies"], *sum(project["optional-dependencies"].values(), [])):
        name, range_ = re.match(r"([\w-]+)(?:\[[\w,]+\])?(.*)", line).groups()
        needed.setdefault(name, range_)
    tested = re.findall(r"^(\S+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    table = re.search(r"tested with \|\n.*\n((?:\|.*\n)+)", (ROOT / "README.md").read_text())[1]
    for row in table.splitlines():
        part, range_, versions = (cell.strip() for cell in row.strip("|").split("|"))
        name, versions = part.split(",")[0], versions.split(", ")
        assert needed[name] == range_ and all(map(SpecifierSet(range_).contains, versions))
        assert name not in dict(tested) or dict(tested)[name] == versions[0]
        if name == "Python":
            claims = [line.rpartition(" ")[2] for line in project["classifiers"]]
            assert [claim for claim in claims if claim.startswith("3.")] == versions


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_notebooks_hold_pictures_and_stay_small(path):
    cells = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not any(output["output_type"] == "error" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.get("name") == "stderr" for output in outputs)  # paths of a machine
    assert path.stat().st_size < 500_000


def test_imports_point_downwards():
    import layers

    upwards = {
        pair: paths
        for pair, paths in layers.imports().items()
        if layers.floor_of(pair[0]) >= layers.floor_of(pair[1])
    }
    assert upwards == {}
    # environments are found by name: only the command line and the page import them
    assert {here for here, there in layers.imports() if there == "envs"} <= {"cli", "play"}
    assert layers.circles() == []
    assert layers.draw().count("<rect") == sum(map(len, layers.FLOORS))
