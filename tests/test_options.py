"""An option is written once: what is checked, what is printed and what ``conf`` says follow."""

import os
import pkgutil
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from inspect import Parameter, isfunction
from itertools import chain
from math import inf, nan
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import pytest
from annotated_types import Gt, Le

import afm_rl.conf
import afm_rl.envs
from afm_rl.cli.settings import commented
from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, kinds_in, options, options_of, with_arguments

CONF = Path(afm_rl.conf.__path__[0])
FILES = sorted(CONF.rglob("*.yaml"))
NEVER = {int: ["1", 1.5, True], float: ["1", nan, inf, True], bool: [1, "true"], Literal: ["?"]}


class Case(NamedTuple):
    """An option of a function."""

    function: object
    name: str

    @property
    def values(self):
        """Values that are allowed, and that are not."""
        each = self.function.options.own[self.name]
        kinds = kinds_in(each.kind)
        items = kinds_in(*kinds.get(Sequence, (None,)))
        kind = next((kind for kind in NEVER if kind in {*kinds, *items}), None)
        if kind is None:
            return [], []
        allowed, never = list({**items, **kinds}.get(Literal, ())), NEVER[kind][:]
        if each.low > -inf:
            never.append(each.low - 1)
            (never if each.is_open else allowed).append(each.low)
        if each.high < inf:
            never.append(each.high + 1)
            allowed.append(each.high)
        ways = [list] if Sequence in kinds else []
        if kind in kinds:
            ways.append(lambda values: values[0])
        least = max(1, each.least)
        return (
            [way([value] * least) for value in values for way in ways]
            for values in (allowed, never)
        )


def cases():
    """Yield each option of each function that checks some."""
    packages = (afm_rl, "afm_rl."), (afm_rl.envs, "afm_rl.envs.")
    for module in chain(*(pkgutil.walk_packages(top.__path__, name) for top, name in packages)):
        for found in (
            vars(import_module(module.name)).values() if "__main__" not in module.name else ()
        ):
            made = vars(found).get("__init__") if isinstance(found, type) else found
            ours = getattr(found, "__module__", None) == module.name
            if ours and isfunction(made) and hasattr(made, "options"):
                yield from (Case(made, name) for name in made.options.own)


CASES = {
    f"{case.function.__module__}.{case.function.__qualname__}: {case.name}": case
    for case in cases()
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_an_option_takes_its_range_and_nothing_else(case):
    function, name = case
    own = function.options.own[name]
    allowed, never = case.values
    for value in [*allowed, *([] if own.default is Parameter.empty else [own.default])]:
        own.check(name, value)
    for value in never:
        with pytest.raises(ConfigurationError, match=rf"^[\w.]*{name}=.*: expected "):
            function(*[None] * function.__wrapped__.__code__.co_argcount, **{name: value})


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_comments_of_settings_are_those_of_the_options(path):
    assert path.read_text() == commented(path), "run `make format`"


class Base:
    @options("thing")
    def __init__(self, size: Annotated[Count, "m"], kind: Annotated[str, "a or b"] = "a"):
        self.size, self.kind = size, kind


class Heir(Base):
    @options("thing")
    def __init__(
        self, rate: Annotated[float, Gt(0), Le(1), "1/s; None"] = 0.5, size: int = 3, **more
    ):
        super().__init__(size, **more)
        self.rate = rate


def test_options_are_inherited_with_the_defaults_of_the_heir():
    known = options_of(Heir)
    assert {name: each.default for name, each in known.items()} == {
        **{"rate": 0.5, "size": 3, "kind": "a"}
    }
    assert [each.text for each in known.values()] == ["1/s, (0, 1]; None", "m, >= 1", "a or b"]
    assert isinstance(Heir(1).rate, float)
    with pytest.raises(ConfigurationError, match=r"^thing.size=0: expected a whole number"):
        Heir(size=0)
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'size'"):
        Base()


def test_options_join_the_other_arguments_of_a_docstring():
    text = "Make.\n\nArgs:\n    x: one,\n        two.\n\nReturns:\n    All."
    added = "    size: m, >= 1.\n    kind: a or b."
    added += "\n\nRaises:\n    ConfigurationError: for an option that is out of its range."
    documented = with_arguments(text, options_of(Base))
    assert documented == text.replace("two.", f"two.\n{added}")
    assert with_arguments("Make.\n\nReturns:\n    All.", options_of(Base)) == (
        f"Make.\n\nArgs:\n{added}\n\nReturns:\n    All."
    )
    assert Base.__init__.__doc__ == f"Args:\n{added}"


ADDED = {  # an option of the loop, and one of a planner
    "transforms/loop_options.py": (r"\Z", '    vigour: Annotated[Limit, "a share"]\n'),
    "planning/icem.py": (r"(?= {8}elites: )", '        vigour: Annotated[Count, "rounds"] = 3,\n'),
}
ASKED = """
import sys
from inspect import signature
from afm_rl.cli import main, settings
from afm_rl.dynamics import Dubins
from afm_rl.planning import ICEM
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform
from afm_rl.transforms.gymnasium import ActionFlowWrapper
for taker in (ActionFlowTransform, ActionFlowPolicy, ActionFlowWrapper, ICEM):
    print("taken:", signature(taker).parameters["vigour"])
    print(*(line for line in taker.__init__.__doc__.split("\\n") if "vigour" in line))
    try:
        taker(None, None, vigour=0)
    except ValueError as error:
        print(error)
transform = ActionFlowTransform(Dubins(), vigour=0.5)
transform.vigour /= 2
print("attribute:", transform.vigour, transform.options["vigour"])
sys.argv = ["settings"]
settings.main()
sys.argv = ["afm-rl", "--help", "corrector=afm", "planner=icem"]
main()
"""


@pytest.mark.slow
def test_an_option_costs_one_place(tmp_path):
    ours = Path(afm_rl.__file__).parent
    for folder, source in {"": ours, "envs": ours.parent / "envs", "conf": CONF}.items():
        shutil.copytree(source, tmp_path / "afm_rl" / folder, dirs_exist_ok=True)
    for name, (where, line) in ADDED.items():
        file = tmp_path / "afm_rl" / name
        file.write_text(re.sub(where, line, file.read_text(), count=1))
    chosen = {"corrector/afm": "null # a share, (0, 2]", "planner/icem": "3 # rounds, >= 1"}
    for name, comment in chosen.items():  # what the command line offers
        with (tmp_path / f"afm_rl/conf/{name}.yaml").open("a") as file:
            file.write(f"vigour: {comment.split()[0]}\n")

    environ = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-c", ASKED]
    done = subprocess.run(command, cwd=tmp_path, env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    answers = done.stdout
    assert answers.count("taken: vigour: float | collections.abc.Sequence[float] | None =") == 3
    assert answers.count("    vigour: a share, (0, 2].") == 3
    for owner in ("transform", "policy", "wrapper"):
        assert f"{owner}.vigour=0: expected a finite number in (0, 2]" in answers
    assert "taken: vigour: int = 3" in answers and "    vigour: rounds, >= 1." in answers
    assert "planner.vigour=0: expected a whole number of at least 1" in answers
    assert "attribute: 0.25 0.25" in answers
    assert all(f"vigour: {comment}\n" in answers for comment in chosen.values())
