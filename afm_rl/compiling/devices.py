"""Where tensors are, and in which precision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import torch
from torch import Tensor, nn
from torchrl.data import TensorSpec

from afm_rl.errors import ConfigurationError


def check_device(name: str, value: object) -> torch.device:
    """Return the device that a setting names.

    Raises:
        ConfigurationError: if it is no device, or is not there.

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
    """Return a spec on the device that ``change`` moves tensors to: specs are no buffers.

    >>> from torchrl.data import Unbounded
    >>> moved(Unbounded((2,)), lambda tensor: tensor.to("meta")).device
    device(type='meta')
    """
    device = change(torch.empty(0, device=spec.device)).device
    return spec if device == spec.device else spec.to(device)


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
