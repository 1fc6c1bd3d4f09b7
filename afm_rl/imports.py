"""Imports of commands, and of packages that need not be there."""

from __future__ import annotations

import gc
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from types import ModuleType

from afm_rl.errors import ConfigurationError, refusing

RUN = ("pandas", "pyarrow", "matplotlib", "jinja2", "rich", "scipy", "tensorboard")
"""Packages of the extra ``run``, which commands need, and the library around a policy does not."""


@contextmanager
def without_collection() -> Iterator[None]:
    """Import without looking for garbage: there is none, and the search is a third of the time.

    What is loaded by then is never searched again.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def needs(owner: str, package: str, extra: str) -> ModuleType:
    """Return a package that comes with one of our extras.

    Raises:
        ConfigurationError: if it cannot be imported, naming who needs it.

    >>> needs("flights", "nowhere", "air")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: flights: needs the package nowhere: pip install ...
    """
    with refusing(f"{owner}: needs the package {package}: pip install 'afm-rl[{extra}]'"):
        return importlib.import_module(package)


def check_installed(owner: str, *packages: str, extra: str = "run") -> None:
    """Check that packages of one of our extras are installed; none of them is imported.

    Raises:
        ConfigurationError: naming who needs them, and how to install them.

    >>> check_installed("reports", "json", "nowhere")
    Traceback (most recent call last):
        ...
    afm_rl.errors.ConfigurationError: reports: needs the package nowhere: pip install 'afm-rl[run]'
    """
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        noun = "package" if len(missing) == 1 else "packages"
        raise ConfigurationError(
            f"{owner}: needs the {noun} {', '.join(missing)}: pip install 'afm-rl[{extra}]'"
        )
