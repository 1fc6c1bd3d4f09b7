"""Shortcuts that cannot be taken while a function is exported, or on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TypeVar

import torch
from torch import Tensor

Result = TypeVar("Result")


def may_look(values: Tensor) -> bool:
    """Return whether what follows may depend on numbers.

    Not while a function is being exported; and on a GPU it would have to be waited for, which takes
    longer than the work that is saved.

    >>> may_look(torch.zeros(3)), may_look(torch.zeros(3, device="meta"))
    (True, False)
    """
    return values.is_cpu and not torch.compiler.is_compiling()


def all_hold(mask: Tensor) -> bool:
    """Return whether a mask is true everywhere; False where it :func:`may not be seen <may_look>`.

    For shortcuts only: what follows must be right whatever this returns.

    >>> all_hold(torch.tensor([True, True])), all_hold(torch.tensor([True, False]))
    (True, False)
    """
    return may_look(mask) and bool(mask.all())


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
