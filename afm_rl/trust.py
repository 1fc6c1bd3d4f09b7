"""Which code settings may call, and the calls.

Hydra calls whatever a ``_target_`` names, so settings from elsewhere are a program. Ours may name
the parts of this library, and packages that the user trusts by name: on the command line
(``trust=[mine]``), in the environment as it was before Hydra, or in the call of
:func:`~afm_rl.missions.build`. No file can add to these. What counts is the name that is there when
it is called, whatever it was made of. A package brings settings in its folder ``conf``, a module in
the folder ``conf`` beside it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from afm_rl.errors import ConfigurationError, refusing

ALLOWED = (
    *("afm_rl.correction", "afm_rl.dynamics", "afm_rl.envs", "afm_rl.learning", "afm_rl.missions"),
    *("afm_rl.planning", "afm_rl.regimes", "afm_rl.transforms"),
    "torch.optim",  # optimisers do no harm
)
REMEDY = (
    "only parts of afm_rl and torch.optim are called; name a package that you trust on the "
    "command line: trust=[PACKAGE]"
)

_trusted: ContextVar[tuple[str, ...] | None] = ContextVar("trusted", default=None)


def trusted() -> tuple[str, ...]:
    """Return what is trusted: names of packages, and paths that end in one."""
    return _trusted.get() or ()


def restricted() -> bool:
    """Tell whether settings are at work; a program may call what it likes."""
    return _trusted.get() is not None


def trust(entries: Iterable[str]) -> list[str]:
    """Trust packages from now on, besides those that are trusted.

    They are searched for where their paths lead, in the present folder if there is none, and only
    after all that is installed.

    Returns:
        The folders that are searched from now on.
    """
    entries = [os.path.abspath(one) if "/" in one else one for one in entries]
    _trusted.set(tuple(dict.fromkeys([*trusted(), *entries])))
    folders = dict.fromkeys(os.path.dirname(entry) or os.getcwd() for entry in entries)
    added = [folder for folder in folders if folder not in sys.path]
    sys.path.extend(added)
    return added


@contextmanager
def trusting(entries: Iterable[str]) -> Iterator[None]:
    """Trust these packages, besides those that are trusted, and no other ones, for a while."""
    before = _trusted.get()
    added = trust(entries)
    try:
        yield
    finally:
        _trusted.set(before)
        for folder in set(added) & set(sys.path):
            sys.path.remove(folder)


def name_of(entry: str) -> str:
    """Return the name of a package.

    >>> name_of("suites/flight"), name_of("my.models")
    ('flight', 'my.models')
    """
    return entry.rstrip("/").rpartition("/")[2]


def conf_folders() -> list[Path]:
    """Return the folders of settings of trusted packages: ``conf`` in each, or beside a module.

    Raises:
        ConfigurationError: for a package that is not there.
    """
    folders = []
    for entry in trusted():
        with refusing(f"trust=[{entry}]: cannot be found"):  # packages around it are imported
            spec = find_spec(name_of(entry))
        inside = list(spec.submodule_search_locations or ()) if spec else []
        origin = spec.origin if spec else None
        place = inside[0] if inside else origin and os.path.dirname(origin)
        if place is None:
            raise ConfigurationError(
                f"trust=[{entry}]: cannot be found: expected a package that is installed, one in "
                f"{os.getcwd()}, or a path that ends in one, such as lib/mine"
            )
        wanted = os.path.dirname(entry)
        if wanted and not os.path.realpath(place).startswith(os.path.realpath(wanted)):
            raise ConfigurationError(
                f"trust=[{entry}]: another package of that name comes first, {place}; rename yours"
            )
        folders.append(Path(place, "conf"))
    return [folder for folder in folders if folder.is_dir()]


def check_trust(entries: Any) -> list[str]:
    """Return names of packages, and paths that end in one.

    Raises:
        ConfigurationError: if they are something else.

    >>> check_trust(["mine", "my.models", "lib/boat"])
    ['mine', 'my.models', 'lib/boat']
    """
    listed = isinstance(entries, list | tuple) and all(isinstance(one, str) for one in entries)
    if not listed or not all(
        name_of(one).replace(".", "_").isidentifier() and "," not in one for one in entries
    ):
        raise ConfigurationError(
            f"trust={entries!r}: expected a list of names of packages, or of paths that end in one"
        )
    return list(entries)


def trusted_folders() -> list[str]:
    """Return the folders of what is trusted: of paths, and of packages. A module has none.

    >>> with trusting(["/robots/arm"]):
    ...     trusted_folders()
    ['/robots/arm']
    """
    folders: list[str] = []
    for entry in trusted():
        if "/" in entry:
            folders.append(entry)
        else:
            with suppress(ImportError, ValueError):  # of a package that is not there
                spec = find_spec(entry)
                folders += (spec.submodule_search_locations or ()) if spec else ()
    return folders


def check_targets(settings: Any, trust: Iterable[str] = ()) -> None:
    """Check that resolved settings name code of this library and of trusted packages only.

    A name leads to an object, and what counts is where that is defined: ``afm_rl.planning.torch``
    is not ours. Modules are imported, nothing is called.

    Args:
        settings: nested mappings and lists.
        trust: further packages.

    Raises:
        ConfigurationError: naming the setting.

    >>> check_targets({"cost": {"_target_": "afm_rl.planning.GoalDistance"}})
    >>> check_targets({"cost": {"_target_": "os.system"}})  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: cost._target_='os.system': only parts of ...
    """
    with trusting(check_trust(list(trust))):
        for place, key, target in leaves(settings):
            if key == "_target_":
                find_code(place, target)


def instantiate(place: str, settings: Any) -> Any:
    """Make what resolved settings describe, innermost parts first.

    As ``hydra.utils.instantiate`` does of ``_target_``, ``_args_``, ``_partial_`` and
    ``_recursive_``; but texts are texts, whatever is written in them, and each ``_target_`` is
    judged at the moment it is called. Mappings become dictionaries.

    Args:
        place: of the settings.
        settings: nested mappings and lists.

    Raises:
        ConfigurationError: naming the setting, for code that is not trusted, or that fails.

    >>> instantiate("robot.schedule", {"_target_": "afm_rl.regimes.Schedule", "at": [0.5]}).at
    (0.5,)
    """
    if isinstance(settings, list | tuple):
        return [instantiate(f"{place}.{number}", part) for number, part in enumerate(settings)]
    if not isinstance(settings, Mapping):
        return settings
    whole = settings.get("_recursive_", True)
    parts = {
        key: instantiate(f"{place}.{key}", part) if whole else part
        for key, part in settings.items()
        if key not in ("_target_", "_recursive_", "_convert_")
    }
    if "_target_" not in settings:
        return parts
    with trusting(()):  # judges also where a program calls this
        code = find_code(f"{place}._target_", settings["_target_"])
    given, later = parts.pop("_args_", ()), parts.pop("_partial_", False)
    with refusing(place):
        return partial(code, *given, **parts) if later else code(*given, **parts)


def leaves(settings: Any, place: str = "") -> Iterator[tuple[str, str, Any]]:
    """Return place, key and value of all that is neither a mapping nor a list.

    >>> list(leaves({"planner": {"horizon": 5}}))
    [('planner.horizon', 'horizon', 5)]
    """
    if isinstance(settings, Mapping):
        pairs: Iterable[tuple[Any, Any]] = settings.items()
    else:
        pairs = enumerate(settings) if isinstance(settings, list | tuple) else ()
    for key, value in pairs:
        where = f"{place}.{key}" if place else str(key)
        if isinstance(value, Mapping | list | tuple) and key != "_target_":
            yield from leaves(value, where)
        else:
            yield where, str(key), value


def check_name(place: str, target: Any) -> None:
    """Check that a name is one of this library or of a trusted package; nothing is imported.

    Raises:
        ConfigurationError: if it is not.
    """
    ours = isinstance(target, str) and _inside(target, [*ALLOWED, *map(name_of, trusted())])
    if not ours or any(part.startswith("_") for part in target.split(".")[1:]):
        raise ConfigurationError(f"{place}={target!r}: {REMEDY}")


def find_code(place: str, target: str) -> Any:
    """Return the class or function that a dotted name leads to, if it is trusted.

    Where no settings are at work, see :func:`restricted`, that is not asked.

    Raises:
        ConfigurationError: if it is not trusted, there is none, or the way to it leaves its
            package.
    """
    if restricted():
        check_name(place, target)
    first, *rest = target.split(".")
    with refusing(f"{place}={target!r}: cannot be found"):  # modules are imported
        found: Any = import_module(first)
        for name in rest:
            if isinstance(found, ModuleType) and not hasattr(found, name):
                import_module(f"{found.__name__}.{name}")
            found = getattr(found, name)
            if isinstance(found, ModuleType) and not _inside(target, [found.__name__]):
                raise ConfigurationError(f"{place}={target!r}: is code of {found!r}; {REMEDY}")
    if not callable(found):
        raise ConfigurationError(f"{place}={target!r}: expected a class or a function")
    home = str(getattr(found, "__module__", None) or type(found).__module__)
    kind = found if isinstance(found, type) else type(found)
    makers = ("afm_rl.missions.factories", "afm_rl.envs")  # functions elsewhere may write files
    ours = _inside(kind.__module__, ALLOWED) or _inside(home, makers)
    if restricted() and not ours and not _inside(home, map(name_of, trusted())):
        raise ConfigurationError(f"{place}={target!r}: is code of {home}; {REMEDY}")
    return found


def _inside(name: str, packages: Iterable[str]) -> bool:
    """Tell whether a dotted name is one of some packages, or in one of them.

    >>> _inside("mine.models.Boat", ["mine"]), _inside("mines.Boat", ["mine"])
    (True, False)
    """
    return any(name == package or name.startswith(f"{package}.") for package in packages)
