"""Imports of commands, and of packages that need not be there."""

from __future__ import annotations

import gc
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from afm_rl.errors import refusing


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
