"""A trained policy in a file: layers as safetensors, what they are for beside them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from afm_rl.artefacts import read_tensors, save_tensors
from afm_rl.errors import ArtefactError


class StoredPolicy(nn.Module):
    r"""A feed-forward policy: linear layers with ReLU between them, tanh at the end.

    It is used as it is: no gradients are recorded for its weights.

    .. math:: a = c + h \tanh(W_n \max(0, \dots \max(0, W_1 o + b_1) \dots) + b_n)

    with centre c and half range h of the action box: the mean action of a trained actor.

    Args:
        layers: weights ``(units, inputs)`` and biases ``(units,)``, in order.
        low, high: action box ``(A,)``.

    >>> import torch
    >>> layers, low, high = [(torch.eye(2), torch.zeros(2))], -2 * torch.ones(2), torch.ones(2)
    >>> StoredPolicy(layers, low, high)(torch.tensor([0.0, 100.0]))
    tensor([-0.5000,  1.0000])
    """

    low: Tensor
    high: Tensor

    def __init__(self, layers: list[tuple[Tensor, Tensor]], low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.weights = nn.ParameterList([weight.detach().float() for weight, _ in layers])
        self.biases = nn.ParameterList([bias.detach().float() for _, bias in layers])
        self.register_buffer("low", low.float())
        self.register_buffer("high", high.float())
        self.requires_grad_(False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` for an observation ``(*B, O)``."""
        value = observation.to(self.low.dtype)
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            value = nn.functional.linear(value, weight, bias)
            value = value.tanh() if index == last else value.relu()
        action = self.low + (self.high - self.low) * (value + 1) / 2
        return action.to(observation.dtype)

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return self.weights[0].shape[1]


def save_policy(
    file: Path,
    layers: list[tuple[Tensor, Tensor]],
    low: Tensor,
    high: Tensor,
    description: Mapping[str, Any],
) -> None:
    """Write a policy, in half precision; ``description`` says how it was made."""
    named = {"low": low.float(), "high": high.float()}
    for index, (weight, bias) in enumerate(layers):
        named[f"{index}.weight"] = weight.detach().half()
        named[f"{index}.bias"] = bias.detach().half()
    save_tensors(Path(file), named, {**description, "kind": "policy", "layers": len(layers)})


def load_policy(file: Path) -> tuple[StoredPolicy, dict[str, Any]]:
    """Return a stored policy and its description.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it is damaged, or holds something else.
    """
    tensors, description = read_tensors(Path(file))
    if description.get("kind") != "policy":
        raise ArtefactError(f"{file}: holds no policy; make one with save_policy")
    count = range(description["layers"])
    layers = [(tensors[f"{index}.weight"], tensors[f"{index}.bias"]) for index in count]
    return StoredPolicy(layers, tensors["low"], tensors["high"]), description
