"""Which code a configuration may call.

Hydra calls whatever a ``_target_`` names, so a configuration from elsewhere is a program. Ours may
name the parts of this library, and packages that the user trusts by name, on the command line
(``trust=[mine]``) or in the call of :func:`~afm_rl.missions.build`. No file can add to these.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

from afm_rl.errors import ConfigurationError
from afm_rl.trust import check_trust, name_of, trusted

PARTS = (
    *("correction", "dynamics", "envs", "flow", "learning", "missions", "planning", "regimes"),
    "transforms",
)
ALLOWED = (*(f"afm_rl.{part}" for part in PARTS), "torch.optim")  # optimisers do no harm
FACTORIES = "afm_rl.missions.factories"
"""The functions of ``afm_rl.missions`` that make parts; others write files."""
MISSIONS = ("afm_rl.missions",)
REMEDY = (
    "only parts of afm_rl and torch.optim are called; name a package that you trust on the "
    "command line: trust=[PACKAGE]"
)
HYDRA = ("hydra_plugins", "hydra._internal.core_plugins")
"""Launchers and sweepers; Hydra itself takes no other classes from there."""
CODE = ("reward", "step")
"""Settings of a robot that may name a function."""
STREAMS = ("ext://sys.stdout", "ext://sys.stderr")
PLACES = [f"robot.{name}" for name in CODE]
HANDLERS = ("logging.StreamHandler", "logging.FileHandler")


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
    names = [name_of(one) for one in (*trusted(), *check_trust(list(trust)))]
    for place, target in _targets(settings, ""):
        _check_name(place, target, [*ALLOWED, *names])
        found = find_code(place, target)
        home = str(getattr(found, "__module__", None) or type(found).__module__)
        makes = isinstance(found, type) or home == FACTORIES
        if not _inside(home, [*ALLOWED, *names]) or (_inside(home, MISSIONS) and not makes):
            raise ConfigurationError(f"{place}={target!r}: is code of {home}; {REMEDY}")


def check_composed(settings: Mapping[str, Any], trust: Iterable[str] = ()) -> None:
    """Check names alone, Hydra's own settings included, before Hydra calls anything.

    Args:
        settings: nested mappings and lists, not resolved.
        trust: further packages.

    Raises:
        ConfigurationError: naming the setting.
    """
    own = settings.get("hydra") or {}
    names = [name_of(one) for one in trust]
    for place, target in _targets(settings, ""):
        plugin = place in ("hydra.launcher._target_", "hydra.sweeper._target_")
        if isinstance(target, str) and "${" in target and not place.startswith("hydra."):
            continue  # checked once it is known
        _check_name(place, target, [*ALLOWED, *names, *(HYDRA if plugin else ())])
    for group in ("job_logging", "hydra_logging"):
        for place, key, value in _texts(own.get(group), f"hydra.{group}"):
            stray = str(value).startswith(("ext://", "cfg://")) and value not in STREAMS
            if key == "()" or (key == "class" and value not in HANDLERS) or stray:
                raise ConfigurationError(
                    f"{place}={value!r}: expected one of {', '.join((*HANDLERS, *STREAMS))}"
                )


def _targets(settings: Any, place: str) -> Iterator[tuple[str, Any]]:
    for where, key, value in _texts(settings, place):
        if key == "_target_" or (where in PLACES and isinstance(value, str)):
            yield where, value


def _texts(settings: Any, place: str) -> Iterator[tuple[str, str, Any]]:
    """Return place, key and value of all that is neither a mapping nor a list."""
    if isinstance(settings, Mapping):
        pairs: Iterable[tuple[Any, Any]] = settings.items()
    else:
        pairs = enumerate(settings) if isinstance(settings, list | tuple) else ()
    for key, value in pairs:
        where = f"{place}.{key}" if place else str(key)
        if isinstance(value, Mapping | list | tuple) and key != "_target_":
            yield from _texts(value, where)
        else:
            yield where, str(key), value


def _check_name(place: str, target: Any, allowed: Iterable[str]) -> None:
    ours = isinstance(target, str) and _inside(target, allowed)
    hidden = ours and any(part.startswith("_") for part in target.split(".")[1:])
    if not ours or (hidden and not target.startswith("hydra._internal.")):
        raise ConfigurationError(f"{place}={target!r}: {REMEDY}")


def _inside(name: str, packages: Iterable[str]) -> bool:
    """Tell whether a dotted name is one of some packages, or in one of them.

    >>> _inside("mine.models.Boat", ["mine"]), _inside("mines.Boat", ["mine"])
    (True, False)
    """
    return any(name == package or name.startswith(f"{package}.") for package in packages)


def find_code(place: str, target: str) -> Any:
    """Return the class or function that a dotted name leads to; whether it is trusted is not asked.

    Raises:
        ConfigurationError: if there is none, or the way to it leaves its package.
    """
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
    return found
