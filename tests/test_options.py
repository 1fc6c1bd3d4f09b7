"""An option is written once: what is checked, what is printed and what ``conf`` says follow."""

import pkgutil
import re
from importlib import import_module
from inspect import isfunction
from itertools import chain
from math import inf, nan
from pathlib import Path
from typing import NamedTuple

import pytest

import afm_rl.conf
import afm_rl.envs
from afm_rl.cli.settings import commented
from afm_rl.errors import ConfigurationError
from afm_rl.options import option, options, options_of, with_arguments

FILES = sorted(Path(afm_rl.conf.__path__[0]).rglob("*.yaml"))
NEVER = {"int": ["1", 1.5, True], "float": ["1", nan, inf, True], "bool": [1, "true"], "str": ["?"]}


class Case(NamedTuple):
    """An option of a function."""

    function: object
    name: str

    @property
    def values(self):
        """Values that are allowed, and that are not."""
        taken = self.function.options
        each, kind = taken.own[self.name], taken.kinds()[self.name]
        text = getattr(kind, "__name__", "") + str(kind)
        kind = next((kind for kind in NEVER if kind in text), None)
        if kind is None or (kind == "str" and not each.choices):
            return [], []
        allowed, never = list(each.choices or ()), NEVER[kind][:]
        if each.low > -inf:
            never.append(each.low - 1)
            (never if each.is_open else allowed).append(each.low)
        if each.high < inf:
            never.append(each.high + 1)
            allowed.append(each.high)
        ways = [list] if "Sequence[" in text else []
        if re.search(kind, re.sub(r"Sequence\[.*\]", "", text)):
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
    own, kind = function.options.own[name], function.options.kinds()[name]
    allowed, never = case.values
    for value in [*allowed, *([] if own.default is ... else [own.default])]:
        own.check(name, kind, value)
    for value in never:
        with pytest.raises(ConfigurationError, match=rf"^[\w.]*{name}=.*: expected "):
            function(*[None] * function.__wrapped__.__code__.co_argcount, **{name: value})


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_comments_of_settings_are_those_of_the_options(path):
    assert path.read_text() == commented(path), "run `make format`"


class Base:
    @options("thing")
    def __init__(self, size: int = option(..., "m", ge=1), kind: str = option("a", "a or b")):
        self.size, self.kind = size, kind


class Heir(Base):
    @options("thing")
    def __init__(self, rate: float = option(0.5, "1/s; None", gt=0, le=1), size: int = 3, **more):
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
