"""Options: each is written once, in the signature that takes it, with its unit, range and reason.

Or in a record, a ``TypedDict``, of which each field is an option of whatever takes ``**settings:
Unpack[...]`` of it.

What is checked of a value, the argument's line in the documentation, its comment in ``conf`` and
the tests of what is refused follow from there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from inspect import Parameter, Signature, cleandoc, signature
from math import inf
from types import EllipsisType, NoneType, SimpleNamespace, UnionType
from typing import Any, NamedTuple, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from afm_rl.errors import ConfigurationError, check_choice, check_count, check_flag, check_number

T = TypeVar("T")
Target = TypeVar("Target", bound=Callable[..., Any])


class Option(NamedTuple):
    """What an argument with a default is for, and what it may be, see :func:`option`."""

    default: Any
    about: str
    low: float
    high: float
    is_open: bool
    choices: Iterable[str] | None
    least: int

    @property
    def text(self) -> str:
        """What it is for, with its range.

        >>> cast(Option, option(None, "pairs of a reading; None: 12", ge=1)).text
        'pairs of a reading, >= 1; None: 12'
        >>> cast(Option, option(0.3, "share that is kept", gt=0, le=1)).text
        'share that is kept, (0, 1]'
        """
        first, semicolon, rest = self.about.partition(";")
        if self.high < inf:
            first += f", {'(' if self.is_open else '['}{self.low}, {self.high}]"
        elif self.low > -inf:
            first += f", {'>' if self.is_open else '>='} {self.low}"
        return first + semicolon + rest

    def check(self, name: str, kind: Any, value: Any) -> Any:
        """Return a value that may be given; numbers as floats, lists of them as lists.

        Args:
            name: of the setting.
            kind: type of the argument. Of numbers, flags, choices, lists of these and None is
                checked what is given, and of no other type.
            value: what is given.

        Raises:
            ConfigurationError: for one that may not be given, naming the setting.
        """
        kinds = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
        if value is None and NoneType in kinds:
            return None
        items = [get_args(one)[0] for one in kinds if get_origin(one) is Sequence]
        if items and not (isinstance(value, int | float | str) and {int, float, str} & {*kinds}):
            return self._check_list(name, items[0], value)
        if self.choices is not None:
            return check_choice(name, value, self.choices)
        if bool in kinds:
            return check_flag(name, value)
        if int in kinds:
            huge = 2**63 - 1  # the largest whole number of 64 bits
            least, most = (int(max(-huge, min(huge, end))) for end in (self.low, self.high))
            return check_count(name, value, low=least, high=most)
        if float in kinds:
            low, high = self.low, self.high
            return check_number(name, value, low=low, high=high, open_low=self.is_open)
        return value

    def _check_list(self, name: str, kind: Any, values: Any) -> list[Any]:
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise ConfigurationError(f"{name}={values!r}: expected a list")
        checked = [self.check(name, kind, value) for value in values]
        if len(checked) < self.least:
            raise ConfigurationError(f"{name}={checked}: expected a list of at least {self.least}")
        return checked


class Default(NamedTuple):
    """The default of a field of a record, for which a ``TypedDict`` has no place; else None."""

    default: Any


@cache
def fields_of(record: Any) -> dict[str, tuple[Option, Any]]:
    """Return the options that a record has as fields, and their types, by name.

    >>> class Limits(TypedDict, total=False):
    ...     reach: Annotated[float, Default(1.0), Interval(gt=0, le=2), "of an arm, m"]
    >>> fields_of(Limits)["reach"][0].text
    'of an arm, m, (0, 2]'
    """
    fields = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        kind, *notes = get_args(hint)
        (about,) = (note for note in notes if isinstance(note, str))
        pairs = ((key, getattr(note, key, None)) for note in notes for key in NOTED)
        noted: Any = {"default": None, **{key: each for key, each in pairs if each is not None}}
        fields[name] = cast(Option, option(about=about, **noted)), kind
    return fields


def filled(record: Any, owner: str, settings: Mapping[str, Any]) -> Any:
    """Return all settings of a record, checked, those that are not given with their defaults.

    Raises:
        ConfigurationError: for one that may not be given, naming it and its owner.
    """
    for name in settings:
        check_choice(f"{owner}: option", name, fields_of(record))
    return {
        name: each.check(f"{owner}.{name}", kind, settings.get(name, each.default))
        for name, (each, kind) in fields_of(record).items()
    }


class Taken(NamedTuple):
    """What a function takes."""

    group: str
    own: dict[str, Option]
    kinds: Callable[[], dict[str, Any]]
    """Returns the types of its options."""
    takers: tuple[Callable[..., Any], ...]
    parts: dict[str, Callable[..., Any]]


NOTHING = Taken("", {}, dict, (), {})
NOTED = ("default", "ge", "gt", "le")


def option(
    default: T | EllipsisType,
    about: str,
    *,
    ge: float = -inf,
    gt: float | None = None,
    le: float = inf,
    choices: Iterable[str] | None = None,
    least: int = 0,
) -> T:
    """Return the default of an argument, as :func:`options` reads it.

    Args:
        default: of the argument; ``...``: it must be given.
        about: what it is for, and its unit.
        ge: the lowest number.
        gt: the same, where that is not allowed itself.
        le: the highest number.
        choices: the texts that are allowed.
        least: how many items a list must have.
    """
    low = ge if gt is None else gt
    return cast(T, Option(default, about, low, le, gt is not None, choices, least))


def choice(default: T, *about: str, **choices: str) -> T:
    """Return the default of an argument that has one of some texts, as :func:`options` reads it.

    Args:
        default: of the argument.
        about: what it is for.
        choices: what each text means.

    >>> cast(Option, choice("mean", "of batches", mean="their mean", none="")).text
    'of batches; mean: their mean; none'
    """
    named = [f"{name}: {text}" if text else name for name, text in choices.items()]
    return option(default, "; ".join([*about, *named]), choices=tuple(choices))


def options(
    group: str, *takers: Callable[..., Any], **parts: Callable[..., Any]
) -> Callable[[Target], Target]:
    """Let a function, or a class by its ``__init__``, check its options whenever it is called.

    Args:
        group: under which settings are found, such as ``planner``.
        takers: what the function hands its further settings, ``**settings``, to.
        parts: by argument, what the function hands a mapping of settings to.

    >>> @options("planner")
    ... def plan(horizon: int = option(5, "steps of a plan", ge=1)):
    ...     return horizon
    >>> plan(), options_of(plan)["horizon"].text
    (5, 'steps of a plan, >= 1')
    >>> plan(horizon=0)
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: planner.horizon=0: expected a whole number of at least 1
    """

    def decorate(function: Any) -> Any:
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        defaults, by_name = function.__defaults__ or (), function.__kwdefaults__ or {}
        given = {**dict(zip(names[len(names) - len(defaults) :], defaults, strict=True)), **by_name}
        own = {name: each for name, each in given.items() if isinstance(each, Option)}
        plain = {name: each.default if name in own else each for name, each in given.items()}
        plain = {name: each for name, each in plain.items() if each is not ...}
        function.__defaults__ = tuple(plain[name] for name in names if name in plain)
        function.__kwdefaults__ = {name: plain[name] for name in by_name if name in plain}
        hints = {name: function.__annotations__[name] for name in own}
        hinted = SimpleNamespace(__annotations__=hints)
        record = record_in(function)
        shared = {} if record is None else fields_of(record)
        own |= {name: each for name, (each, _) in shared.items()}
        shared_kinds = {name: kind for name, (_, kind) in shared.items()}
        kinds = cache(  # when first needed
            lambda: get_type_hints(hinted, function.__globals__) | shared_kinds
        )

        def check(name: str, value: Any) -> Any:
            if name in parts and value is not None:
                check_settings(parts[name], value)
            place = f"{group}.{name}" if group else name
            return own[name].check(place, kinds()[name], value) if name in own else value

        @wraps(function)
        def checked(*args: Any, **settings: Any) -> Any:
            settings = {name: check(name, value) for name, value in settings.items()}
            return function(*map(check, names, args), *args[len(names) :], **settings)

        checked.options = Taken(group, own, kinds, takers, parts)  # type: ignore[attr-defined]
        if record is not None:
            checked.__signature__ = with_fields(signature(function), record)  # type: ignore[attr-defined]
        checked.__doc__ = with_arguments(function.__doc__ or "", own)
        return checked

    return decorate


def record_in(function: Any) -> Any:
    """Return the record whose fields a function takes by name, ``**settings: Unpack[...]``."""
    for name, text in function.__annotations__.items():
        if str(text).startswith("Unpack["):
            hinted = SimpleNamespace(__annotations__={name: text})
            return get_args(get_type_hints(hinted, function.__globals__)[name])[0]
    return None


def with_fields(taking: Signature, record: Any) -> Signature:
    """Return a signature with the fields of a record in the place of ``**settings``."""
    *named, _ = taking.parameters.values()
    fields = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=each.default, annotation=kind)
        for name, (each, kind) in fields_of(record).items()
    ]
    return taking.replace(parameters=[*named, *fields])


def options_of(target: Any) -> dict[str, Option]:
    """Return the options that a function or class takes, with its own defaults, by name.

    Those of its bases, and of what further settings are handed to, are among them.
    """
    if hasattr(target, "__total__"):  # a TypedDict
        return {name: each for name, (each, _) in fields_of(target).items()}
    sources = [target]
    if isinstance(target, type):
        sources = [vars(base).get("__init__") for base in target.__mro__]
    known: dict[str, Option] = {}
    for source in sources:
        taken = getattr(source, "options", NOTHING)
        known = {**taken.own, **known}
        for taker in taken.takers:
            known = {**options_of(taker), **known}
    arguments = signature(target).parameters
    open_end = any(each.kind is Parameter.VAR_KEYWORD for each in arguments.values())
    known = {name: each for name, each in known.items() if name in arguments or open_end}
    own = {
        name: known[name]._replace(default=each.default)
        for name, each in arguments.items()
        if name in known
    }
    return {**own, **known, **own}


def check_settings(function: Any, settings: Mapping[str, Any]) -> None:
    """Check settings of a function that is called later, by name and value.

    >>> @options("fit")
    ... def fit(*, epochs: int = option(8, "passes", ge=1)): ...
    >>> check_settings(fit, {"epoch": 9})
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: fit: setting='epoch': expected one of epochs
    """
    group, own, kinds, *_ = function.options
    if not isinstance(settings, Mapping):
        raise ConfigurationError(f"{group}={settings!r}: expected settings by name")
    for name, value in settings.items():
        check_choice(f"{group}: setting", name, own)
        own[name].check(f"{group}.{name}", kinds()[name], value)


def with_arguments(text: str, known: dict[str, Option]) -> str:
    """Return a docstring with the lines of options at the end of its ``Args:``.

    >>> print(with_arguments("Plan.", options_of(option)))
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


def parts_of(target: Any) -> dict[str, Callable[..., Any]]:
    """Return, by argument, what a function hands a mapping of settings to."""
    return getattr(target, "options", NOTHING).parts
