"""Which code settings may call, and the calls.

Hydra calls whatever a ``_target_`` names, so settings from elsewhere are a program. Ours may name
the parts of this library, and packages that the user trusts by name, on the command line
(``trust=[mine]``) or in the call of :func:`~afm_rl.missions.build`. No file can add to these. What
counts is the name that is there when it is called, whatever it was made of.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

from afm_rl.errors import AFMError, ConfigurationError
from afm_rl.trust import check_trust, name_of, restricted, trusted, trusting

PARTS = (
    *("correction", "dynamics", "envs", "learning", "missions", "planning", "regimes"),
    "transforms",
)
ALLOWED = (*(f"afm_rl.{part}" for part in PARTS), "torch.optim")  # optimisers do no harm
MAKERS = ("afm_rl.missions.factories", "afm_rl.envs")
"""Where functions may be called, too, and not only classes: other functions write files."""
REMEDY = (
    "only parts of afm_rl and torch.optim are called; name a package that you trust on the "
    "command line: trust=[PACKAGE]"
)


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
    try:
        return partial(code, *given, **parts) if later else code(*given, **parts)
    except AFMError:
        raise
    except Exception as error:  # code of others may raise anything
        raise ConfigurationError(f"{place}: {str(error) or type(error).__name__}") from error


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
    ours = isinstance(target, str) and _inside(target, [*ALLOWED, *_names()])
    if not ours or any(part.startswith("_") for part in target.split(".")[1:]):
        raise ConfigurationError(f"{place}={target!r}: {REMEDY}")


def find_code(place: str, target: str) -> Any:
    """Return the class or function that a dotted name leads to, if it is trusted.

    Where no settings are at work, see :func:`~afm_rl.trust.restricted`, that is not asked.

    Raises:
        ConfigurationError: if it is not trusted, there is none, or the way to it leaves its
            package.
    """
    if restricted():
        check_name(place, target)
    first, *rest = target.split(".")
    try:
        found: Any = import_module(first)
        for name in rest:
            if isinstance(found, ModuleType) and not hasattr(found, name):
                import_module(f"{found.__name__}.{name}")
            found = getattr(found, name)
            if isinstance(found, ModuleType) and not _inside(target, [found.__name__]):
                raise ConfigurationError(f"{place}={target!r}: is code of {found!r}; {REMEDY}")
    except ConfigurationError:
        raise
    except Exception as error:  # modules that are imported may raise anything
        raise ConfigurationError(f"{place}={target!r}: cannot be found: {error}") from error
    if not callable(found):
        raise ConfigurationError(f"{place}={target!r}: expected a class or a function")
    home = str(getattr(found, "__module__", None) or type(found).__module__)
    kind = found if isinstance(found, type) else type(found)
    ours = _inside(kind.__module__, ALLOWED) or _inside(home, MAKERS)
    if restricted() and not ours and not _inside(home, _names()):
        raise ConfigurationError(f"{place}={target!r}: is code of {home}; {REMEDY}")
    return found


def _names() -> list[str]:
    return [name_of(entry) for entry in trusted()]


def _inside(name: str, packages: Iterable[str]) -> bool:
    """Tell whether a dotted name is one of some packages, or in one of them.

    >>> _inside("mine.models.Boat", ["mine"]), _inside("mines.Boat", ["mine"])
    (True, False)
    """
    return any(name == package or name.startswith(f"{package}.") for package in packages)
