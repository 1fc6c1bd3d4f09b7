"""Shortcuts that are not allowed while a function is exported, or on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache, wraps
from itertools import chain, islice
from typing import Any, TypeVar

import torch
from torch import Tensor

Result = TypeVar("Result")
Records = tuple[Any, ...]


def may_look(values: Tensor) -> bool:
    """Return whether control flow may depend on the numbers of a tensor.

    Not while a function is exported, and not on a GPU, because waiting for the numbers takes longer
    than the work that is saved.

    >>> may_look(torch.zeros(3)), may_look(torch.zeros(3, device="meta"))
    (True, False)
    """
    return values.is_cpu and not torch.compiler.is_compiling()


def all_hold(mask: Tensor) -> bool:
    """Return whether a mask is true everywhere; False if :func:`may_look` forbids reading it.

    Use it only for shortcuts: the result must be the same if this returns False.

    >>> all_hold(torch.tensor([True, True])), all_hold(torch.tensor([True, False]))
    (True, False)
    """
    return may_look(mask) and bool(mask.all())


def none_holds(mask: Tensor) -> bool:
    """Return whether a mask is false everywhere, as :func:`all_hold` does.

    >>> none_holds(torch.tensor([False, False])), none_holds(torch.tensor([True, False]))
    (True, False)
    """
    return may_look(mask) and not bool(mask.any())


def same(values: Tensor, others: Tensor) -> bool:
    """Return whether two tensors are equal, as :func:`all_hold` does; False with NaN.

    >>> same(torch.ones(2), torch.ones(2)), same(torch.ones(2), torch.zeros(2))
    (True, False)
    """
    return values.dtype is others.dtype and may_look(values) and torch.equal(values, others)


def cached(maxsize: int) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Cache the tensors that a function returns, as ``lru_cache`` does, but not during an export.

    Tensors of an export are placeholders without numbers, which would break later calls.

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


BRANCHES = ContextVar("branches", default=True)


@contextmanager
def without_branches() -> Iterator[None]:
    """Let exported functions compute both sides of each branch, and select one.

    The export takes a third of the time, but each call of the graph does the work of both sides.
    """
    token = BRANCHES.set(False)
    try:
        yield
    finally:
        BRANCHES.reset(token)


def somewhere(
    mask: Tensor,
    work: Callable[..., Sequence[Tensor]],
    still: Sequence[Tensor],
    *given: Tensor | None,
) -> list[Tensor]:
    """Return what ``work(*given)`` returns where a mask ``(*B)`` holds, and ``still`` elsewhere.

    The work is skipped if the mask is false everywhere; in an exported function only if tensors are
    ``given``. The work gets the rows where the mask is true, or all rows if :func:`may_look`
    forbids reading it.

    Args:
        mask: rows for which the work is needed.
        work: returns as many tensors ``(*B, ...)`` as there are in ``still``.
        still: results elsewhere, of the same shapes.
        given: tensors ``(*B, ...)``, or None.

    >>> mask = torch.tensor([True, False])
    >>> somewhere(mask, lambda x: [1 / x], [torch.zeros(2)], torch.tensor([4.0, 0.0]))
    [tensor([0.2500, 0.0000])]
    """

    def everywhere() -> list[Tensor]:
        at = [mask[(..., *[None] * (old.dim() - mask.dim()))] for old in still]
        parts = zip(at, work(*given), still, strict=True)
        return [torch.where(here, new.to(old.dtype), old) for here, new, old in parts]

    def laid_out(values: Sequence[Tensor | None]) -> list[Any]:
        return [x if x is None else x.clone(memory_format=torch.contiguous_format) for x in values]

    if not may_look(mask):
        # torch 2.13 has neither nested branches nor branches with an unknown number of missions.
        static = not any(isinstance(n, torch.SymInt) for n in mask.shape)
        branches = static and torch.compiler.is_exporting() and BRANCHES.get()
        if not (given and branches):
            return everywhere()
        # Inputs and outputs of branches must not share memory, and must have the same layout.
        given, still = tuple(laid_out(given)), laid_out(still)
        any_holds = mask.any()
        return torch.cond(any_holds, lambda: laid_out(everywhere()), lambda: laid_out(still))
    if not bool(mask.any()):
        return list(still)
    if bool(mask.all()):
        pairs = zip(work(*given), still, strict=True)
        return [new.to(old.dtype, copy=new.is_inference()) for new, old in pairs]
    if not given:
        return everywhere()
    found = [old.clone() for old in still]
    rows = (None if part is None else part[mask] for part in given)
    for old, new in zip(found, work(*rows), strict=True):
        old[mask] = new.to(old.dtype)
    return found


def where_needed(
    mask: Tensor, work: Callable[..., Records], idle: Callable[..., Records], *given: Any
) -> Records:
    """Apply ``work`` to records where a mask ``(*B)`` is true, and ``idle`` elsewhere.

    Records are named tuples of tensors ``(*B, ...)``, or None. The work is done for the rows where
    the mask is true, or for all rows if :func:`may_look` forbids reading the mask.

    >>> from typing import NamedTuple
    >>> class Number(NamedTuple):
    ...     value: Tensor
    >>> mask, number = torch.tensor([True, False]), Number(torch.tensor([4.0, 0.0]))
    >>> where_needed(mask, lambda x: (Number(1 / x.value),), lambda x: (x,), number)
    (Number(value=tensor([0.2500, 0.0000])),)
    """
    rows = int(mask.sum()) if may_look(mask) else None
    if rows == mask.numel():
        return work(*given)
    elsewhere = idle(*given)
    if rows == 0:
        return elsewhere

    def flat_work(*fields: Tensor | None) -> list[Tensor]:
        return [*chain(*work(*_records(fields, given)))]

    return _records(somewhere(mask, flat_work, [*chain(*elsewhere)], *chain(*given)), elsewhere)


def _records(fields: Iterable[Tensor | None], like: Records) -> Records:
    """Return a sequence of fields as records of the same kinds as others."""
    left = iter(fields)
    return tuple(type(record)._make(islice(left, len(record))) for record in like)
