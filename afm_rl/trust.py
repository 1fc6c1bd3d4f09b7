"""Which code a configuration may call.

Hydra calls whatever a ``_target_`` names, so a configuration from elsewhere is a program. Ours may
name the parts of this library, and packages that the user trusts by name, on the command line
(``trust=[mine]``) or in the call of :func:`~afm_rl.missions.build`. No file can add to these. A
trusted package may also bring settings to choose from, in its folder ``conf``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from afm_rl.errors import ConfigurationError

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
TRUST = "AFM_RL_TRUST"
"""Environment variable in which the command line tells its other processes what is trusted."""
CODE = ("reward", "step")
"""Settings of a robot that may name a function."""
STREAMS = ("ext://sys.stdout", "ext://sys.stderr")
PLACES = [f"robot.{name}" for name in CODE]
HANDLERS = ("logging.StreamHandler", "logging.FileHandler")


def trusted() -> list[str]:
    """Return what this process trusts: names of packages, and paths that end in one."""
    return [entry for entry in os.environ.get(TRUST, "").split(",") if entry]


def trust(entries: Iterable[str]) -> None:
    """Trust packages, here and in processes that this one starts.

    They are searched for where their paths lead, in the present folder if there is none, and only
    after all that is installed.
    """
    entries = [os.path.abspath(one) if "/" in one else one for one in entries]
    os.environ[TRUST] = ",".join(dict.fromkeys([*trusted(), *entries]))
    for entry in trusted():
        folder = os.path.dirname(entry) or os.getcwd()
        if folder not in sys.path:
            sys.path.append(folder)


@contextmanager
def trusting(entries: Iterable[str]) -> Iterator[None]:
    """Trust packages for a while."""
    before, path = os.environ.get(TRUST), sys.path[:]
    trust(entries)
    try:
        yield
    finally:
        sys.path[:] = path
        os.environ.pop(TRUST)
        os.environ.update({} if before is None else {TRUST: before})


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
        try:
            spec = find_spec(name_of(entry))
        except Exception as error:  # the packages around it are imported, and may raise anything
            raise ConfigurationError(f"trust=[{entry}]: cannot be found: {error}") from error
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
