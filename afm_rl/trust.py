"""Packages that are trusted while settings are at work: their code may be called.

They are named on the command line, in the environment as it was before Hydra, or in the call of
:func:`~afm_rl.missions.build`; settings themselves cannot add to them. A package brings settings in
its folder ``conf``, a module in the folder ``conf`` beside it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from afm_rl.errors import ConfigurationError

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
