"""Packages that a command trusts: their code may be called, and their settings chosen.

A package brings settings in its folder ``conf``, a module in the folder ``conf`` beside it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from afm_rl.errors import ConfigurationError

TRUST = "AFM_RL_TRUST"
"""Environment variable in which the command line tells its other processes what is trusted."""


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
