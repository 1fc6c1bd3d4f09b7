"""Devices and precision of tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import torch
from torch import Tensor, nn
from torchrl.data import TensorSpec

from afm_rl.errors import ConfigurationError


def check_device(name: str, value: object) -> torch.device:
    """Return the device of a setting.

    Raises:
        ConfigurationError: if the name is not a device, or this machine does not have it.

    >>> check_device("device", "cpu")
    device(type='cpu')
    """
    there = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    there += ["mps"] if torch.backends.mps.is_available() else []
    wanted = "cuda:0" if value == "cuda" else value
    if wanted not in there:
        hint = ""
        if str(value).startswith("cuda") and not torch.backends.cuda.is_built():
            hint = f", and torch {torch.__version__} was built without CUDA"
        raise ConfigurationError(
            f"{name}={value!r}: available: {', '.join(there)}{hint}; choose one of these"
        )
    return torch.device(str(wanted))


def device_of(module: nn.Module) -> torch.device:
    """Return the device of a module's tensors; the CPU if it has none.

    >>> device_of(nn.Linear(2, 3))
    device(type='cpu')
    """
    tensor = next(chain(module.parameters(), module.buffers()), None)
    return torch.device("cpu") if tensor is None else tensor.device


def moved(spec: TensorSpec, change: Callable[[Tensor], Tensor]) -> TensorSpec:
    """Return a spec on the device to which ``change`` moves tensors, because specs are not buffers.

    >>> from torchrl.data import Unbounded
    >>> moved(Unbounded((2,)), lambda tensor: tensor.to("meta")).device
    device(type='meta')
    """
    device = change(torch.empty(0, device=spec.device)).device
    return spec if device == spec.device else spec.to(device)


class CastCache:
    """Cast tensors once, and again only after they changed.

    The cache detects changes by optimisers, ``copy_``, ``load_state_dict`` and a new ``data``. It
    cannot detect in-place changes of ``parameter.data``, because torch hides them.

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
        """Return an empty cache, because a copied model has other parameters."""
        return type(self)(self.dtype)

    @torch.no_grad()
    def of(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Return the copies of ``tensors``, of the same shapes; do not change them."""
        if not self._current(tensors):
            fits = [copy.shape for copy in self._copies] == [one.shape for one in tensors]
            if not fits:  # otherwise torch reuses their memory
                self._copies = [torch.empty_like(one, dtype=self.dtype) for one in tensors]
            for copy, one in zip(self._copies, tensors, strict=True):
                copy.copy_(one)
            # The aliases keep the memory, so that no other tensor gets its address.
            self._seen = [(one.detach(), one._version) for one in tensors]
        return self._copies

    def _current(self, tensors: Sequence[Tensor]) -> bool:
        """Return whether these are the tensors of the last call, unchanged."""
        return len(tensors) == len(self._seen) and all(
            (one.data_ptr(), one.shape, one.stride(), one._version)
            == (alias.data_ptr(), alias.shape, alias.stride(), version)
            for one, (alias, version) in zip(tensors, self._seen, strict=True)
        )
