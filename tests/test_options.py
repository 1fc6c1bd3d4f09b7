"""An option is written once: what is checked, what is printed and what ``conf`` says follow."""

import pkgutil
from collections.abc import Sequence
from importlib import import_module
from inspect import Parameter, isfunction, signature
from itertools import chain
from math import inf, nan
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import pytest
from annotated_types import Gt, Le

import afm_rl.conf
import afm_rl.envs
from afm_rl import ActionFlowVectorWrapper, ActionFlowWrapper
from afm_rl.cli.settings import commented
from afm_rl.errors import ConfigurationError
from afm_rl.options import Count, kinds_in, options, options_of, with_arguments
from afm_rl.transforms import ActionFlowPolicy, ActionFlowTransform
from afm_rl.transforms.loop_options import LoopOptions

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


@pytest.mark.parametrize(
    "shell", [ActionFlowTransform, ActionFlowPolicy, ActionFlowWrapper, ActionFlowVectorWrapper]
)
def test_each_shell_takes_all_options_of_the_loop_and_documents_them(shell):
    known = options_of(shell)
    for name in LoopOptions.__annotations__:
        assert name in signature(shell).parameters
        assert f"    {name}: {known[name].text}" in shell.__init__.__doc__
