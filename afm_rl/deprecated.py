"""Old names of public things: they work in this version, with a warning that names the new one."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from functools import partial, wraps
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, TypeVar

import lazy_loader

NAMES = {
    "afm_rl.envs.Table": "afm_rl.envs.SampledReference",
    "afm_rl.play.Robot": "afm_rl.play.PlayedRobot",
    "afm_rl.learning.watching.Watching": "afm_rl.transforms.collect_then_fit.CollectThenFit",
    "afm_rl.regimes.StaticRegime": "afm_rl.regimes.Regime",
    "afm_rl.report.check_video": "afm_rl.film.check_video",
}
"""New names of parts, both with their package."""
_LATE = {"late": ("delay_compensation", {"predict": True, "leave": False})}
ARGUMENTS: dict[str, dict[str, tuple[str, dict[Any, Any]]]] = {
    "ActionFlow": {"readings": ("hypotheses", {})},
    "ActionFlowTransform": _LATE,
    "GymnasiumShell": _LATE,
}
"""New names of arguments, by function or class, and new values for old ones."""

Function = TypeVar("Function", bound=Callable[..., Any])


def lazy_package(package: str, file: str) -> tuple[Callable[[str], Any], Any, list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, which loads what is asked.

    Its names are those in ``__init__.pyi``, and the old ones.

    Args:
        package: its ``__name__``.
        file: its ``__file__``.
    """
    load, list_names, names = lazy_loader.attach_stub(package, file)

    def get(name: str) -> Any:
        return _new(package, name, level=4) if f"{package}.{name}" in NAMES else load(name)

    return get, list_names, names


class OldModules(MetaPathFinder, Loader):
    """Finds modules that are gone and of which names are in :data:`NAMES`."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        known = any(old.rpartition(".")[0] == fullname for old in NAMES)
        return ModuleSpec(fullname, self) if known else None

    def exec_module(self, module: ModuleType) -> None:
        module.__getattr__ = partial(_new, module.__name__)  # type: ignore[method-assign]


sys.meta_path.append(OldModules())  # after those that find what is there


def old_attribute(old: str, new: str) -> property:
    """Return the property that stands for an attribute that is called ``new`` now."""

    def get(instance: Any) -> Any:
        _warn(f"{type(instance).__name__}.{old}", new)
        return getattr(instance, new)

    return property(get)


def old_arguments(function: Function) -> Function:
    r"""Let a function take the old names of its :data:`ARGUMENTS`, too.

    >>> ARGUMENTS["wait"] = {"late": ("delay_compensation", {"predict": True})}
    >>> @old_arguments
    ... def wait(delay_compensation):
    ...     return delay_compensation
    >>> with warnings.catch_warnings(record=True) as issued:
    ...     warnings.simplefilter("always")
    ...     print(wait(late="predict"), issued[0].message, sep="\n")
    True
    wait: late is called delay_compensation now; the old name goes with the next version
    >>> del ARGUMENTS["wait"]
    """
    owner = function.__qualname__.removesuffix(".__init__")
    is_method = owner != function.__qualname__

    @wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        for old, (new, values) in ARGUMENTS.get(owner, {}).items():
            if old in given:
                _warn(f"{type(args[0]).__name__ if is_method else owner}: {old}", new)
                value = given.pop(old)
                given[new] = values.get(value, value) if values else value
        return function(*args, **given)

    return call  # type: ignore[return-value]


def _new(package: str, name: str, level: int = 3) -> Any:
    """Return what an old name stands for; ``level``: of the caller, who is warned."""
    if f"{package}.{name}" not in NAMES:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    _warn(f"{package}.{name}", NAMES[f"{package}.{name}"], level)
    module, _, part = NAMES[f"{package}.{name}"].rpartition(".")
    return getattr(import_module(module), part)


def _warn(old: str, new: str, level: int = 3) -> None:
    text = f"{old} is called {new} now; the old name goes with the next version"
    warnings.warn(text, DeprecationWarning, stacklevel=level)
