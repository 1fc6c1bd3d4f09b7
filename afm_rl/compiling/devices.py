"""Where tensors are."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain

import torch
from torch import Tensor, nn
from torchrl.data import TensorSpec

from afm_rl.errors import ConfigurationError


def check_device(name: str, value: object) -> torch.device:
    """Return the device that a setting names.

    Args:
        name: of the setting.
        value: ``"cpu"``, ``"cuda"``, ``"cuda:1"`` or ``"mps"``.

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
            f"{name}={value!r}: here is {', '.join(there)}{hint}; choose what is here"
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
