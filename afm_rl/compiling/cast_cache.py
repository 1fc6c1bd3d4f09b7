"""Parameters cast to another precision, once per change."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class CastCache:
    """Cast tensors once, and again only when they have changed.

    Changes through optimisers, ``copy_``, ``load_state_dict`` or a new ``data`` are noticed;
    in-place changes of ``parameter.data`` are hidden by torch, and so missed.

    Args:
        dtype: precision of the copies.

    >>> weight, cache = torch.ones(2), CastCache(torch.bfloat16)
    >>> first = cache.of([weight])[0]
    >>> cache.of([weight])[0] is first
    True
    >>> cache.of([weight.mul_(3)])[0]
    tensor([3., 3.], dtype=torch.bfloat16)
    """

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self._seen: list[tuple[Tensor, int]] = []
        self._copies: list[Tensor] = []

    def __deepcopy__(self, memo: dict) -> CastCache:
        """Return an empty one: a copied model's parameters are others."""
        return type(self)(self.dtype)

    @torch.no_grad()
    def of(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Return the copies of ``tensors``, of the same shapes; not to be changed."""
        if not self._current(tensors):
            fits = [copy.shape for copy in self._copies] == [one.shape for one in tensors]
            if not fits:  # otherwise their memory serves again
                self._copies = [torch.empty_like(one, dtype=self.dtype) for one in tensors]
            for copy, one in zip(self._copies, tensors, strict=True):
                copy.copy_(one)
            # The aliases keep the memory, so that nothing else can come to lie at its address.
            self._seen = [(one.detach(), one._version) for one in tensors]
        return self._copies

    def _current(self, tensors: Sequence[Tensor]) -> bool:
        """Return whether these are the tensors seen last, unchanged."""
        return len(tensors) == len(self._seen) and all(
            (one.data_ptr(), one.shape, one.stride(), one._version)
            == (alias.data_ptr(), alias.shape, alias.stride(), version)
            for one, (alias, version) in zip(tensors, self._seen, strict=True)
        )
