"""Old names of public things: they work in this version, with a warning that names the new one."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from typing import Any, TypeVar

import lazy_loader

NAMES = {
    "afm_rl.envs.Table": "afm_rl.envs.SampledReference",
    "afm_rl.play.Robot": "afm_rl.play.PlayedRobot",
    "afm_rl.learning.watching.Watching": "afm_rl.transforms.collect_then_fit.CollectThenFit",
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
        new = NAMES.get(f"{package}.{name}")
        if new is None:
            return load(name)
        _warn(f"{package}.{name}", new)
        module, _, part = new.rpartition(".")
        return getattr(import_module(module), part)

    return get, list_names, names


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

    @wraps(function)
    def call(*args: Any, **given: Any) -> Any:
        for old, (new, values) in ARGUMENTS.get(owner, {}).items():
            if old in given:
                _warn(f"{owner}: {old}", new)
                value = given.pop(old)
                given[new] = values.get(value, value) if values else value
        return function(*args, **given)

    return call  # type: ignore[return-value]


def _warn(old: str, new: str) -> None:
    text = f"{old} is called {new} now; the old name goes with the next version"
    warnings.warn(text, DeprecationWarning, stacklevel=3)
