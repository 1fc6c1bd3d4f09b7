"""Shortcuts that cannot be taken while a function is being exported."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TypeVar

import torch
from torch import Tensor

Result = TypeVar("Result")


def all_hold(mask: Tensor) -> bool:
    """Return whether a mask is true everywhere; False while a function is being exported.

    For shortcuts only: what follows must be right whatever this returns.

    >>> all_hold(torch.tensor([True, True])), all_hold(torch.tensor([True, False]))
    (True, False)
    """
    return not torch.compiler.is_compiling() and bool(mask.all())


def cached(maxsize: int) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Keep the tensors that a function returned, as ``lru_cache`` does; but none of an export.

    These are placeholders without numbers, which would spoil every later call.

    >>> @cached(maxsize=4)
    ... def ones(size):
    ...     return torch.ones(size)
    >>> ones(3) is ones(3)
    True
    """

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        kept = lru_cache(maxsize)(function)

        @wraps(function)
        def call(*args: object) -> Result:
            return function(*args) if torch.compiler.is_compiling() else kept(*args)

        call.cache_clear = kept.cache_clear  # type: ignore[attr-defined]
        return call

    return decorate
