"""The commands that README, docs and suites print run, at a small size."""

import argparse
import contextlib
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pandas as pd
import pytest
from harness import shrink
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf
from pages import PAGES, ROOT, blocks, commands, name_of, write_files

from afm_rl.cli import compare, diagnose, export, play, report
from afm_rl.cli.overrides import checked
from afm_rl.correction import export as correction_export
from afm_rl.jobs.run import begin, finish
from afm_rl.missions import build, prepare, run

ROWS = 40  # of a log
LITTLE = {
    "budget": 2,
    "seeds": 1,
    "device": "cpu",
    "planner.candidates": 4,
    "planner.iterations": 1,
    "dynamics.pretrain.flights": 2,
}
LESS = {  # programs that run to their end, with less to do
    "benchmarks/suites/zoo/run.py": "--policies pendulum_sac --faults none WiFi "
    "--methods 'without AFM' AFM --episodes 1 --at 20 --steps 60",
    "benchmarks/suites/zoo/arena.py": "--robots Pendulum --episodes 1 --steps 44",
    "benchmarks/suites/double_pendulum/run.py": "--robots pendubot --methods MPC+positions "
    "--repeats 1 --steps 12",
    "benchmarks/suites/double_pendulum/board.py": "--robots pendubot --seeds 1 --steps 12",
    "benchmarks/suites/double_pendulum/motors.py": "",  # without their logs
    "benchmarks/suites/zoo/film.py": "--seconds 0.2",
    "benchmarks/suites/legged/run.py": "--folder benchmarks/suites/legged/robots --robots small "
    "--methods 'without AFM' --faults none --seeds 1 --steps 160",
    "benchmarks/suites/reality/run.py": "--robots ground_robot --methods 'without AFM' "
    "--draws 1 --at 1 --after 4",
    "benchmarks/suites/furuta/run.py": "--methods iCEM+LQR --parts A --runs 2 --steps 12",
}
BUILT = {"method=afm_sysid"}  # takes seconds a step: built, and not run
OF_DM_CONTROL = ("robot=dm_control", "robot=inversion_cartpole", "robot=inversion_cheetah")
NEED = {"robot=gymnasium": "mujoco"} | dict.fromkeys((*OF_DM_CONTROL, "DMControlEnv"), "dm_control")
FOLDER = re.compile(r"outputs/\S+")
GROUPS = ("robot", "dynamics", "dynamics.base", "updater", "corrector", "planner", "cost")
RUN = set()  # combinations of parts that have run


class Parsed(Exception):
    """The arguments were understood; the program need not run."""


@pytest.fixture
def desk(monkeypatch, tmp_path):
    """Work in a folder with the examples alone, from which modules are imported."""
    monkeypatch.chdir(tmp_path)
    for name in ("examples", "benchmarks", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    suites = (ROOT / "benchmarks" / "suites").glob("*/*.py")
    for name in ("mine", *(file.stem for file in suites)):
        sys.modules.pop(name, None)


@pytest.fixture(scope="session")
def results(tmp_path_factory):
    """Write the results of a small run."""
    folder = tmp_path_factory.mktemp("results")
    few = ["method=physics", "label=physics", "budget=5", "seeds=2", "planner.candidates=4"]
    with initialize_config_module("afm_rl.conf", version_base="1.3"):
        cfg = compose("config", few)
    begin(folder, cfg)
    finish(folder)
    return str(folder)


def settings_of_methods(first, swept=()):
    """Return the settings as they are, or those of each method that is compared, AFM first."""
    if swept:
        return [[*first, f"method={method}"] for method in swept]
    single = {"agent", "method", "dynamics", "corrector", "updater"}
    if single & {choice.partition("=")[0] for choice in first}:
        return [first]
    whole = compose("config", [choice for choice in first if "." not in choice.partition("=")[0]])
    methods = sorted(whole.compare, key=lambda name: not name.startswith("afm"))
    return [[*first, f"method={method}"] for method in methods]


def composed(overrides):
    """Compose settings; None if this method lacks one of them, which others have."""
    try:
        return compose("config", overrides)
    except ConfigCompositionException as error:
        if "Could not override" not in str(error):
            raise
    return None


def first_of(override):
    """Return the first value of a sweep, as text; of an interval its lowest one."""
    value = override.value()
    if isinstance(value, IntervalSweep):
        return str(value.start)
    return next(iter(override.sweep_string_iterator()))


def shrunk(overrides):
    """Compose the settings of a command line, with its first choices and little to do."""
    parsed = OverridesParser.create().parse_overrides(overrides)
    first = [
        f"{each.get_key_element()}={first_of(each)}"
        if each.is_sweep_override()
        else each.input_line
        for each in parsed
        if not each.get_key_element().startswith("hydra.")
    ]
    methods = [each for each in parsed if each.get_key_element() == "method"]
    swept = [
        m for each in methods if each.is_sweep_override() for m in each.sweep_string_iterator()
    ]
    left_out = ("out=", "hydra/", "method=") if swept else ("out=", "hydra/")
    first = [choice for choice in first if not choice.startswith(left_out)]
    cfg = next(filter(None, map(composed, settings_of_methods(first, swept))))
    return shrink(cfg, LITTLE)


def run_afm_rl(page, words, desk, cache):
    write_files(page, desk)
    asked = [word for word in words if word != "-m"]
    with checked(asked) as names, initialize_config_module("afm_rl.conf", version_base="1.3"):
        cfg = shrunk(asked)
        agent = build(cfg, names)
    parts = tuple(OmegaConf.select(cfg, f"{group}._target_") for group in GROUPS)
    if not BUILT & set(asked) and parts not in RUN:  # commands of the same parts run once
        RUN.add(parts)
        prepare(agent, cache)
        assert len(run(agent).missions)


def run_tool(main, words, monkeypatch, desk, results):
    """Run a command that reads files: logs are cut, results are small ones."""
    arguments = []
    for word in words[1:]:
        if FOLDER.match(word) and "--out" not in arguments[-1:]:
            word = results
        elif word.endswith((".csv", ".parquet")) and (ROOT / word).exists():
            word = cut(ROOT / word, desk)
        arguments.append(word)
    if main is diagnose.main:
        arguments += ["--out", "diagnosis"]
    monkeypatch.setattr("sys.argv", [words[0], *arguments])
    main()


def cut(path, desk):
    """Copy the first rows of a log."""
    read = pd.read_csv if path.suffix == ".csv" else pd.read_parquet
    rows = read(path)[:ROWS]
    target = desk / path.name
    rows.to_csv(target, index=False) if path.suffix == ".csv" else rows.to_parquet(target)
    return str(target)


def run_python(words, monkeypatch, results):
    """Run a program; one that takes long only as far as its arguments."""
    as_module = words[1] == "-m"
    name, *arguments = words[2:] if as_module else words[1:]
    arguments = [results if FOLDER.match(a) else a for a in arguments]
    if not as_module and "parse_args" not in (ROOT / name).read_text():
        assert not arguments
        compile((ROOT / name).read_text(), name, "exec")  # takes minutes
        return
    if name in LESS:
        arguments += shlex.split(LESS[name])
    else:
        parse = argparse.ArgumentParser.parse_args

        def parsed(parser, *given):
            raise Parsed(parse(parser, *given))

        monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
    monkeypatch.setattr("sys.argv", [name, *arguments])
    monkeypatch.syspath_prepend(str((ROOT / name).parent))
    start = runpy.run_module if as_module else runpy.run_path
    try:
        start(name, run_name="__main__")
    except Parsed:
        pass
    except SystemExit as end:
        assert not end.code


def check_install(words):
    """Check that extras exist."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for name in re.findall(r"\[(\w+)\]", " ".join(words)):
        assert name in extras["optional-dependencies"]


def check_make(words):
    assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def check_file(words):
    assert words[0] != "sh" or (ROOT / words[1]).exists()


def check_completion(words):
    """Let bash read the line, and complete a choice as it does after a tab."""
    line = "afm-rl method=afm_ph"
    typed = f'COMP_LINE="{line}" COMP_POINT={len(line)} COMP_CWORD=1'
    script = f'eval "{words[1]}"; {typed}; hydra_bash_completion; echo "${{COMPREPLY[@]}}"'
    path = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
    said = subprocess.check_output(["bash", "-c", script], env=os.environ | {"PATH": path})
    assert said.split() == [b"method=afm_physics"]


ELSEWHERE = {"pip": check_install, "make": check_make, "sh": check_file, "eval": check_completion}
ELSEWHERE |= dict.fromkeys(("kill", "pytest", "cp"), check_file)


def skip_where_missing(code):
    for name, package in NEED.items():
        if name in code:
            pytest.importorskip(package)


def tier(page, first=True):
    """README is in `make test`, of each guide the first command of a kind in `make check`."""
    name = name_of(page)
    measured = "benchmarks.md", "deviations.md", "paper.md", "paper_agent.md", "results.md"
    if page not in PAGES or name in measured or not first:
        return [pytest.mark.slow]
    return [] if name == "README.md" else [pytest.mark.check]


def kind_of(words):
    """Return the program, and the robot or the format of the log that it is about."""
    starts = "robot=", "examples/real_logs"
    about = next((word for word in words if word.startswith(starts)), "")
    return words[0], about if about.startswith("robot=") else Path(about).suffix


def cases():
    """Return each command by its page and its words; many of a page are of one kind."""
    found, begun = [], {}
    for page, words in commands():
        kinds = begun.setdefault(page, set())
        first = name_of(page) == "README.md" or kind_of(words) not in kinds
        kinds.add(kind_of(words))
        name = f"{name_of(page)}: {' '.join(words)}"
        found.append(pytest.param((page, words), id=name, marks=tier(page, first)))
    return found


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("command", cases())
def test_commands_run(command, desk, cache, results, monkeypatch, capsys):
    page, words = command
    program = words[0]
    skip_where_missing(words)
    if program == "afm-rl" and {"--help", "--cfg"} & set(words):
        with initialize_config_module("afm_rl.conf", version_base="1.3"):
            compose("config", [word for word in words[1:] if "=" in word])
    elif program == "afm-rl-export" and words[1].startswith("actuators="):
        for name in ("tick_graph", "search_graph"):  # tests/correction/test_export.py writes them
            monkeypatch.setattr(correction_export, name, lambda core, *sizes: b"graph")
        run_tool(export.main, words, monkeypatch, desk, results)
    elif program in ("afm-rl", "afm-rl-export"):
        run_afm_rl(page, words[1:], desk, cache)
    elif program == "afm-rl-report":
        run_tool(report.main, [*words, "--no-figures"], monkeypatch, desk, results)
    elif program == "afm-rl-diagnose":
        listing = words[1].endswith(".ulg") and len(words) == 2  # says what there is to choose
        with pytest.raises(SystemExit, match="2") if listing else contextlib.nullcontext():
            run_tool(diagnose.main, words, monkeypatch, desk, results)
    elif program == "afm-rl-compare":
        little = ["--faults", "half", "--episodes", "1", "--steps", "14", "--at", "12"]
        run_tool(compare.main, [*words, *little], monkeypatch, desk, results)
    elif program == "afm-rl-play":
        monkeypatch.setattr(play, "_run", lambda options: None)
        run_tool(play.main, words, monkeypatch, desk, results)
    elif program == "python":
        if page.suffix == ".md":
            write_files(page, desk)
        run_python(words, monkeypatch, results)
    else:
        ELSEWHERE[program](words)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "page", [pytest.param(p, id=name_of(p), marks=tier(p)) for p in PAGES if blocks(p, "python")]
)
def test_snippets_run(page, desk, short_trainings):
    skip_where_missing("".join(blocks(page, "python")))
    rest = write_files(page, desk)
    exec(compile("\n".join(rest), str(page), "exec"), {"__name__": "page"})
