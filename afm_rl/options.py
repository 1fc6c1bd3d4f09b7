"""Options: each is written once, where it is taken, with its unit, range and reason.

    candidates: Annotated[int, Ge(1), "candidates per iteration, N"] = 300

in a signature under :func:`options`, or as a field of a record: a ``TypedDict``, of which whatever
takes ``**settings: Unpack[...]`` has the fields. A range of a list is that of its items. What is
checked of a value, the argument's line in the documentation, its comment in ``conf`` and the tests
of what is refused follow from there.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from inspect import Parameter, cleandoc, signature
from math import inf
from types import NoneType, SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, Unpack, get_args, get_origin

from annotated_types import Ge, Gt, Le

from afm_rl.errors import ConfigurationError, check_choice, check_count, check_flag, check_number

Natural = Annotated[int, Ge(0)]
Count = Annotated[int, Ge(1)]
NonNegative = Annotated[float, Ge(0)]
Positive = Annotated[float, Gt(0)]
Share = Annotated[float, Ge(0), Le(1)]

Target = TypeVar("Target", bound=Callable[..., Any])

RENAMED = {
    "launcher": "hydra/launcher",
    "planner.box_key": "planner.bounds_key",
    "planner.population": "planner.candidates",
    "corrector.longest_delay": "corrector.max_delay",
    "corrector.noise_rate": "corrector.noise_learning_rate",
    "corrector.odds": "corrector.nominal_log_odds",
    "corrector.place": "corrector.context_coordinates",
    "corrector.quiet": "corrector.innovation_gate",
    "corrector.tails": "corrector.student_t_dof",
    "robot.place": "robot.context_coordinates",
    **{
        f"{owner}.{old}": f"{owner}.{new}"
        for owner in ("corrector", "policy", "transform", "wrapper")
        for old, new in (
            ("most", "max_correction"),
            ("rate", "max_correction_rate"),
            ("extend_action_box", "extend_effect_bounds"),
        )
    },
}
"""Renamed settings: the old name and the new one."""

_REGRESSION = "the corrector is a regression now, without a network, weights or samples"
_TABLE = "the table of hypotheses is the same for all robots"
_TORCH = "the corrector is computed by torch alone"
REMOVED = {
    "core": _TORCH,
    "corrector.checkpoint": _REGRESSION,
    "corrector.core": _TORCH,
    "corrector.hypotheses": f"{_TABLE}; rows of your own are given to ActionFlow",
    "corrector.network": _REGRESSION,
    "corrector.plain": f"{_TABLE}, and has the prior of each one",
    "corrector.rows": "all remembered transitions count, corrector.memory of them",
    "corrector.samples": _REGRESSION,
    "corrector.source_std": _REGRESSION,
    "corrector.steps": _REGRESSION,
    "robot.hypotheses": _TABLE,
}
"""Removed settings and the reason."""


def moved(place: str) -> str | None:
    """Return a line about a setting that was renamed or removed; None if it was not.

    >>> moved("corrector.core")
    'corrector.core is gone: the corrector is computed by torch alone'
    """
    if place in RENAMED:
        return f"{place} is now called {RENAMED[place]}"
    return f"{place} is gone: {REMOVED[place]}" if place in REMOVED else None


def check_renamed(place: str) -> None:
    """Check that a setting was not renamed or removed.

    Raises:
        ConfigurationError: naming the new one, or why it is gone.

    >>> check_renamed("planner.population")
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: planner.population is now called planner.candidates
    """
    if (message := moved(place)) is not None:
        raise ConfigurationError(message)


class Default(NamedTuple):
    """The default of a field of a record, for which a ``TypedDict`` has no place; else None."""

    default: Any


class Option(NamedTuple):
    """What an argument is for, and what it may be."""

    kind: Any
    """Its type."""
    about: str
    default: Any
    low: Any
    high: Any
    is_open: bool
    least: int
    """How many items a list must have."""

    @property
    def text(self) -> str:
        """What it is for, with its range.

        >>> as_option(Annotated[Count | None, "pairs of a reading; None: 12"]).text
        'pairs of a reading, >= 1; None: 12'
        >>> as_option(Annotated[Positive, Le(1), "share that is kept"]).text
        'share that is kept, (0, 1]'
        """
        first, semicolon, rest = self.about.partition(";")
        if self.high < inf:
            first += f", {'(' if self.is_open else '['}{self.low}, {self.high}]"
        elif self.low > -inf:
            first += f", {'>' if self.is_open else '>='} {self.low}"
        return first + semicolon + rest

    def check(self, name: str, value: Any) -> Any:
        """Return a value that may be given; numbers as floats, lists of them as lists.

        Of numbers, flags, choices, lists of these and None is checked what is given, and of no
        other type.

        Args:
            name: of the setting.
            value: what is given.

        Raises:
            ConfigurationError: for one that must not be given, naming the setting.
        """
        kinds, low, high = kinds_in(self.kind), self.low, self.high
        if value is None and NoneType in kinds:
            return None
        alone = isinstance(value, int | float | str) and {int, float, str} & {*kinds}
        if Sequence in kinds and not alone:
            return self._replace(kind=kinds[Sequence][0])._check_list(name, value)
        if Literal in kinds:
            return check_choice(name, value, kinds[Literal])
        if bool in kinds:
            return check_flag(name, value)
        if int in kinds:
            huge = 2**63 - 1  # the largest whole number of 64 bits
            return check_count(name, value, low=max(low, -huge), high=min(high, huge))
        if float in kinds:
            return check_number(name, value, low=low, high=high, open_low=self.is_open)
        return value

    def _check_list(self, name: str, values: Any) -> list[Any]:
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise ConfigurationError(f"{name}={values!r}: expected a list")
        checked = [self.check(name, value) for value in values]
        if len(checked) < self.least:
            raise ConfigurationError(f"{name}={checked}: expected a list of at least {self.least}")
        return checked


def kinds_in(hint: Any) -> dict[Any, tuple[Any, ...]]:
    """Return the types that a value may have, each with what it is of, as a list is of numbers."""
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return {get_origin(kind) or kind: get_args(kind) for kind in kinds}


def notes_in(hint: Any) -> list[Any]:
    """Return what is noted of a type, and of those that it is made of."""
    kinds, notes = get_args(hint), []
    if get_origin(hint) is Annotated:
        kinds, notes = kinds[:1], [*kinds[1:]]
    return notes + [note for kind in kinds for note in notes_in(kind)]


def as_option(hint: Any, default: Any = None) -> Option:
    """Return the option that ``Annotated[...]`` describes."""
    notes, names = notes_in(hint), ("ge", "gt", "le", "min_length", "default")
    said = {name: getattr(note, name) for note in notes for name in names if hasattr(note, name)}
    (about,) = (note for note in notes if isinstance(note, str))
    plain = typing.get_type_hints(SimpleNamespace(__annotations__={"it": hint}))["it"]
    ends = said.get("gt", said.get("ge", -inf)), said.get("le", inf), "gt" in said
    default = said.get("default", default)
    return Option(plain, about, default, *ends, said.get("min_length", 0))


@cache
def fields_of(record: Any) -> dict[str, Option]:
    """Return the options that a record has as fields, by name.

    >>> class Limits(typing.TypedDict, total=False):
    ...     reach: Annotated[float, Default(1.0), Gt(0), Le(2), "of an arm, m"]
    >>> fields_of(Limits)["reach"].text
    'of an arm, m, (0, 2]'
    """
    hints = typing.get_type_hints(record, include_extras=True)
    return {name: as_option(hint) for name, hint in hints.items()}


def filled(record: Any, owner: str, settings: Mapping[str, Any]) -> Any:
    """Return all settings of a record, checked; those that are not given have their defaults.

    Raises:
        ConfigurationError: for one that must not be given, naming it and its owner.
    """
    taken = Taken(owner, fields_of(record))
    return {name: each.default for name, each in taken.own.items()} | taken.checked(settings)


class Taken(NamedTuple):
    """What a function takes."""

    group: str = ""
    own: Mapping[str, Option] = {}
    takers: tuple[Callable[..., Any], ...] = ()
    parts: Mapping[str, Callable[..., Any]] = {}

    def check(self, name: str, value: Any) -> Any:
        """Return the value of an argument, if it may be given."""
        if name in self.parts and value is not None:
            check_settings(self.parts[name], value)
        place = f"{self.group}.{name}" if self.group else name
        return self.own[name].check(place, value) if name in self.own else value

    def checked(self, settings: Any) -> dict[str, Any]:
        """Return settings, all of which are options, if they may be given."""
        if not isinstance(settings, Mapping):
            raise ConfigurationError(f"{self.group}={settings!r}: expected settings by name")
        for name in settings:
            check_renamed(f"{self.group}.{name}")
            check_choice(f"{self.group}: setting", name, self.own)
        return {name: self.check(name, value) for name, value in settings.items()}


def options(
    group: str, *takers: Callable[..., Any], **parts: Callable[..., Any]
) -> Callable[[Target], Target]:
    """Let a function, or a class by its ``__init__``, check its options whenever it is called.

    Args:
        group: under which settings are found, such as ``planner``.
        takers: what the function hands its further settings, ``**settings``, to.
        parts: by argument, what the function hands a mapping of settings to.

    >>> @options("planner")
    ... def plan(horizon: Annotated[int, Ge(1), "steps of a plan"] = 5):
    ...     return horizon
    >>> plan(), options_of(plan)["horizon"].text
    (5, 'steps of a plan, >= 1')
    >>> plan(horizon=0)
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: planner.horizon=0: expected a whole number of at least 1
    """

    def decorate(target: Any) -> Any:
        if isinstance(target, type):
            target.__init__ = decorate(target.__init__)  # type: ignore[misc]
            return target
        taking, own = signature(target, eval_str=True), dict[str, Option]()
        arguments: list[Parameter] = []
        for argument in taking.parameters.values():
            hint, kind, fields = argument.annotation, argument.kind, dict[str, Option]()
            if get_origin(hint) is Annotated:
                fields = {argument.name: as_option(hint, argument.default)}
            elif get_origin(hint) is Unpack:
                kind, fields = Parameter.KEYWORD_ONLY, fields_of(*get_args(hint))
            own |= fields
            arguments += [
                Parameter(name, kind, default=each.default, annotation=each.kind)
                for name, each in fields.items()
            ] or [argument]
        taken, names = Taken(group, own, takers, parts), [each.name for each in arguments]
        closed = any(get_origin(each.annotation) is Unpack for each in taking.parameters.values())

        @wraps(target)
        def checked(*args: Any, **settings: Any) -> Any:
            for name in settings.keys() - taking.parameters.keys():
                if moved(f"{group}.{name}") and name not in options_of(checked):  # of a taker
                    check_renamed(f"{group}.{name}")
                if closed:
                    check_choice(f"{group}: setting", name, own)
            settings = {name: taken.check(name, value) for name, value in settings.items()}
            return target(*map(taken.check, names, args), *args[len(names) :], **settings)

        checked.options = taken  # type: ignore[attr-defined]
        checked.__doc__ = with_arguments(target.__doc__ or "", own)
        checked.__signature__ = taking.replace(parameters=arguments)  # type: ignore[attr-defined]
        return checked

    return decorate


def options_of(target: Any) -> dict[str, Option]:
    """Return the options that a function or class takes, with its own defaults, by name.

    Those of its bases, and of what further settings are handed to, are among them.
    """
    if hasattr(target, "__total__"):  # a TypedDict
        return fields_of(target)
    sources = [target]
    if isinstance(target, type):
        sources = [vars(base).get("__init__") for base in target.__mro__]
    known: dict[str, Option] = {}
    for taken in (getattr(source, "options", Taken()) for source in sources):
        for options in (taken.own, *map(options_of, taken.takers)):
            known = {**options, **known}
    arguments = signature(target).parameters
    own = {
        name: known[name]._replace(default=each.default)
        for name, each in arguments.items()
        if name in known
    }
    open_end = any(each.kind is Parameter.VAR_KEYWORD for each in arguments.values())
    return {**own, **known, **own} if open_end else own


def check_settings(function: Any, settings: Mapping[str, Any]) -> None:
    """Check settings of a function that is called later, by name and value.

    >>> @options("fit")
    ... def fit(*, epochs: Annotated[int, Ge(1), "passes"] = 8): ...
    >>> check_settings(fit, {"size": 9})
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: fit: setting='size': expected one of epochs
    """
    function.options.checked(settings)


def with_arguments(text: str, known: Mapping[str, Option]) -> str:
    """Return a docstring with the lines of options at the end of its ``Args:``.

    >>> print(with_arguments("Plan.", {}))
    Plan.
    """
    if not known:
        return text
    lines = [f"    {name}: {each.text}." for name, each in known.items()]
    if "Raises:" not in text:
        lines += ["", "Raises:", "    ConfigurationError: for an option that is out of its range."]
    rows = cleandoc(text).split("\n")
    if "Args:" not in rows:
        ends = ("Returns:", "Yields:", "Raises:", ">>> ")
        at = next((n for n, row in enumerate(rows) if row.startswith(ends)), len(rows))
        rows[at:at] = ["Args:", ""] if at < len(rows) else ["", "Args:"]
    start = rows.index("Args:") + 1
    inside = (n for n, row in enumerate(rows[start:], start) if not row.startswith("    "))
    at = next(inside, len(rows))
    return "\n".join([*rows[:at], *lines, *rows[at:]]).strip()


def parts_of(target: Any) -> Mapping[str, Callable[..., Any]]:
    """Return, by argument, what a function hands a mapping of settings to."""
    return getattr(target, "options", Taken()).parts
