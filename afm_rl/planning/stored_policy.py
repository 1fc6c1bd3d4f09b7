"""A trained policy in a file: layers as safetensors, what they are for beside them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from afm_rl.errors import ArtefactError, ConfigurationError, check_number
from afm_rl.planning.law import LawPlanner
from afm_rl.planning.planning_env import PlanningEnv
from afm_rl.storage.artefacts import digest_of, read_tensors, save_tensors


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


class PolicyPlanner(LawPlanner):
    """A stored policy in the place of a planner: it acts on what it sees, and plans nothing.

    Args:
        env: the planning environment: where state and action are, the action's box, and what a
            policy sees of a state.
        file: written by :func:`save_policy`.
        noise: standard deviation of normal noise on the actions, in half ranges, while TorchRL
            explores, as its collectors do: without it a model cannot learn from the policy's data
            what other actions would have done.

    Raises:
        ConfigurationError: if there is no such file, or the policy's sizes do not fit.
        ArtefactError: if the file is damaged, or holds something else.
    """

    def __init__(self, env: PlanningEnv, file: str | Path | None, noise: float = 0.1) -> None:
        super().__init__(env, self._act)
        if not isinstance(file, str | Path):
            raise ConfigurationError(
                f"planner.file={file!r}: expected a file that save_policy wrote"
            )
        try:
            self.policy, _ = load_policy(Path(file).expanduser())
        except (ConfigurationError, ArtefactError) as error:
            raise type(error)(f"planner.file: {error}") from error
        self.noise = check_number("planner.noise", noise, low=0.0)
        box = self.action_spec.space
        state = torch.zeros(1, env.dynamics.state_size, dtype=box.low.dtype)
        wanted = self._seen(state).shape[-1], env.dynamics.action_size
        sizes = self.policy.observation_size, len(self.policy.low)
        if sizes != wanted:
            raise ConfigurationError(
                f"planner.file={file}: a policy of {sizes[0]} observations and {sizes[1]} actions; "
                f"the robot has {wanted[0]} and {wanted[1]}"
            )

    @property
    def signature(self) -> dict[str, str]:
        """What tells this policy from others."""
        return {"policy": digest_of(self.policy.state_dict())}

    def _act(self, seen: Tensor) -> Tensor:
        """Return the policy's actions, with noise while TorchRL explores."""
        action, box = self.policy(seen), self.action_spec.space
        if exploration_type() != ExplorationType.RANDOM:
            return action
        return action + 0.5 * self.noise * (box.high - box.low) * torch.randn_like(action)
