"""`envs/` is `afm_rl.envs`, `conf/` is `afm_rl.conf`, and the wheel holds all there is."""

import doctest
import importlib
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import afm_rl

ROOT = Path(__file__).resolve().parents[1]
SUITES = ROOT / "benchmarks" / "suites"
sys.path.append(str(SUITES))
INSTALLED_AS = {"afm_rl": "afm_rl", "envs": "afm_rl/envs", "conf": "afm_rl/conf"}
NOT_INSTALLED = {".md", ".pyc"}  # notes for readers of the tree, caches
POLICIES = Path("examples/policies/zoo"), "afm_rl/play/policies"  # some of them, for the page


def sources(*folders: str) -> set[str]:
    """Files of the source folders, named as they are to stand in site-packages."""
    return {
        f"{INSTALLED_AS[folder]}/{path.relative_to(ROOT / folder).as_posix()}"
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix not in NOT_INSTALLED and not path.name.startswith(".")
    }


def modules() -> list[str]:
    """Import names of all modules but `__main__`, which would start a program."""
    files = sorted(name for name in sources("afm_rl", "envs") if name.endswith(".py"))
    names = [name.removesuffix(".py").replace("/", ".") for name in files]
    packages = (folder.parent for folder in SUITES.glob("*/__init__.py"))
    names += [f"{folder.name}.{path.stem}" for folder in packages for path in folder.glob("*.py")]
    names.append("results")  # of benchmarks
    return [name.removesuffix(".__init__") for name in names if not name.endswith("__main__")]


@pytest.mark.parametrize("name", modules())
def test_examples_in_docstrings(name):
    # By import name: a run by path would load envs/ a second time, as `envs`.
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.testmod(importlib.import_module(name), optionflags=flags).failed == 0


def test_dir_lists_what_the_package_gives_and_loads_no_torch():
    code = "import sys, afm_rl; print(*dir(afm_rl)); print('torch' in sys.modules)"
    names, torch_is_loaded = run(sys.executable, "-c", code, cwd=ROOT).splitlines()
    assert torch_is_loaded == "False"
    assert {"ActionFlowTransform", "FaultWrapper", "check_model", "compare"} <= {*names.split()}
    assert all(hasattr(afm_rl, name) for name in names.split())


def run(*command: str | Path, cwd: Path, **env: str) -> str:
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=os.environ | env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def build_wheel(source: Path, folder: Path) -> None:
    build = ["build", "--wheel", "--no-isolation", "--outdir", folder, source]
    run(sys.executable, "-m", *build, cwd=folder)


def install(folder: Path, *wheels: Path) -> Path:
    """Make an environment that holds the wheels and nothing else; return its interpreter."""
    python = folder / "venv" / "bin" / "python"
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
    pip = ["pip", "--python", python, "install", "--no-deps", "--no-index", "--no-compile"]
    run(sys.executable, "-m", *pip, *wheels, cwd=folder)
    return python


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """A new environment that holds the wheel and nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in (*INSTALLED_AS, POLICIES[0]):
        shutil.copytree(
            ROOT / name, folder / "source" / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / "source")

    build_wheel(folder / "source", folder)
    return install(folder, *folder.glob("*.whl"))


@pytest.fixture
def site_packages(environment):
    (folder,) = environment.parents[1].glob("lib/python*/site-packages")
    return folder


def borrowed() -> dict[str, str]:
    """Lend the libraries of this environment to another.

    By a path on which `.pth` files have no effect: an editable installation works through one, and
    would lend the wheel the modules that it lacks.
    """
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    return {"PYTHONPATH": os.pathsep.join(libraries), "PYTHONDONTWRITEBYTECODE": "1"}


@pytest.fixture
def run_there(environment, tmp_path):
    """Runs a command in the new environment, from a folder outside the repository."""
    there = environment.parent
    return lambda name, *rest: run(there / name, *rest, cwd=tmp_path, **borrowed())


patient = pytest.mark.timeout(300)  # whichever test comes first builds the wheel


@pytest.mark.check
@patient
def test_the_wheel_holds_every_source_file_and_no_other(site_packages):
    installed = (p.relative_to(site_packages) for p in site_packages.rglob("*") if p.is_file())
    found = {p.as_posix() for p in installed if not p.parts[0].endswith(".dist-info")}
    policies = {name for name in found if name.startswith(POLICIES[1])}
    assert found - policies == sources(*INSTALLED_AS)
    assert all((ROOT / POLICIES[0] / Path(name).name).is_file() for name in policies)


@pytest.mark.slow
@patient
def test_the_wheel_imports_and_plays_from_anywhere(run_there, site_packages):
    pytest.importorskip("mujoco")
    names = [folder.replace("/", ".") for folder in INSTALLED_AS.values()]
    code = "from importlib import import_module as of\n"
    code += f"for name in {names}: print(of(name).__file__)\n"
    code += "from afm_rl.play import ROBOTS, make_robot\n"
    code += "for name in ROBOTS: print(make_robot(name).name)"
    said = run_there("python", "-c", code)
    for folder in INSTALLED_AS.values():
        assert str(site_packages / folder / "__init__.py") in said
    assert "half_cheetah\nhopper\nwalker2d\nant\nswimmer\npendulum\ncart_pole\n" in said


@pytest.mark.slow
@patient
@pytest.mark.parametrize("command", [["afm-rl"], ["python", "-m", "afm_rl.cli"]], ids=" ".join)
def test_the_command_line_runs_from_anywhere(run_there, command):
    assert "planner" in run_there(*command, "--help")  # the help shows the composed configuration


@pytest.mark.slow
@patient
def test_a_project_with_envs_and_conf_of_its_own_lives_beside_ours(environment, tmp_path):
    shutil.copytree(ROOT / "examples" / "external_project", tmp_path / "project")
    build_wheel(tmp_path / "project", tmp_path)
    python = install(tmp_path, *tmp_path.glob("*.whl"), *environment.parents[2].glob("*.whl"))

    def there(name, *rest):
        return run(python.parent / name, *rest, cwd=tmp_path / "venv", **borrowed())

    (site,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    names = ["envs", "conf", "afm_rl.envs", "afm_rl.conf"]
    code = "from importlib import import_module as of; import sys\n"
    code += "for name in sys.argv[1:]: print(of(name).__file__)"
    found = there("python", "-c", code, *names).splitlines()
    assert found == [f"{site}/{name.replace('.', '/')}/__init__.py" for name in names]

    assert there("ferry").startswith("landed after ")  # with our planner and cost
    assert there("ferry", "correct=false").startswith("lost after ")

    remove = ["pip", "--python", python, "uninstall", "--yes"]
    run(sys.executable, "-m", *remove, "afm-rl", cwd=tmp_path)
    assert {path.name for path in site.iterdir()} - {"ferry-1.0.dist-info"} == {
        *("conf", "envs", "ferry")
    }
    assert there("python", "-c", "import envs; print(envs.__file__)") == f"{found[0]}\n"
    run(sys.executable, "-m", *remove, "ferry", cwd=tmp_path)
    assert list(site.iterdir()) == []
