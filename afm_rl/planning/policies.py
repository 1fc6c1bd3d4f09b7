"""A trained policy from a file in the place of a planner."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from afm_rl.dynamics import Oracle
from afm_rl.errors import ArtefactError, ConfigurationError, check_choice, refusing
from afm_rl.options import NonNegative, options
from afm_rl.planning.planning_env import PlanningEnv
from afm_rl.storage.artefacts import digest_of, read_tensors, save_tensors

ACTIVATIONS = ("relu", "tanh", "elu", "silu", "gelu")  # of torch.nn.functional


class StoredPolicy(nn.Module):
    r"""The mean action of a trained feed-forward actor.

    It is used as it is: no gradients are recorded for its weights.

    .. math::
        x_0 = \operatorname{clip}((o - \mu) / \sigma, \pm k), \qquad
        x_i = \phi(W_i x_{i-1} + b_i), \qquad y = W_n x_{n-1} + b_n

    and the action is :math:`c + h \tanh(\operatorname{clip}(y, \pm l))`, with centre c and half
    range h of the action bounds, or, if not squashed, y clamped to them.

    Args:
        layers: weights ``(units, inputs)`` and biases ``(units,)``, in order.
        low, high: action bounds ``(A,)``.
        activation: phi between the layers: relu, tanh, elu, silu or gelu.
        squash: whether a tanh keeps the action within its bounds, or a clamp does.
        limit: l, of what is squashed.
        normaliser: mean and standard deviation ``(2, O)`` of the observations; None without.
        clip: k, of normalised observations.

    Raises:
        ConfigurationError: for layers or action bounds that do not fit each other.

    >>> import torch
    >>> layers, low, high = [(torch.eye(2), torch.zeros(2))], -2 * torch.ones(2), torch.ones(2)
    >>> StoredPolicy(layers, low, high)(torch.tensor([0.0, 100.0]))
    tensor([-0.5000,  1.0000])
    """

    low: Tensor
    high: Tensor
    normaliser: Tensor | None

    def __init__(
        self,
        layers: Sequence[tuple[Tensor, Tensor]],
        low: Tensor,
        high: Tensor,
        activation: str = "relu",
        squash: bool = True,
        limit: float = math.inf,
        normaliser: Tensor | None = None,
        clip: float = math.inf,
    ) -> None:
        super().__init__()
        shapes = [tuple(weight.shape) for weight, _ in layers]
        outputs = [shape[:1] for shape in shapes]
        inputs = [*(shape[1:] for shape in shapes[1:]), tuple(low.shape)]
        if (
            {len(shape) for shape in shapes} != {2}
            or not outputs == inputs == [tuple(bias.shape) for _, bias in layers]
            or low.shape != high.shape
            or (normaliser is not None and normaliser.shape != (2, shapes[0][1]))
        ):
            raise ConfigurationError(
                f"policy: layers of the shapes {shapes!s:.200} and action bounds of the shapes "
                f"{tuple(low.shape)} and {tuple(high.shape)}: expected layers that fit each other, "
                "their biases, the bounds and the normaliser"
            )
        parts = [*chain.from_iterable(layers), *([] if normaliser is None else [normaliser])]
        if not all(part.is_floating_point() and part.float().isfinite().all() for part in parts):
            raise ConfigurationError("policy: expected finite real numbers as its weights")
        low, high = low.float(), high.float()
        if not (low <= high).all() or (squash and not (high - low).isfinite().all()):
            ends = f"{low.tolist()!s:.80} to {high.tolist()!s:.80}"
            raise ConfigurationError(
                f"policy: expected finite action bounds, low <= high, got {ends}"
            )
        if not (limit > 0 and clip > 0 and (normaliser is None or (normaliser[1] > 0).all())):
            raise ConfigurationError(
                f"policy: limit={limit}, clip={clip}, or a deviation: expected positive numbers"
            )
        self.weights = nn.ParameterList([weight.detach().float() for weight, _ in layers])
        self.biases = nn.ParameterList([bias.detach().float() for _, bias in layers])
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.register_buffer("normaliser", None if normaliser is None else normaliser.float())
        self.form: dict[str, Any] = {
            "activation": check_choice("policy.activation", activation, ACTIVATIONS),
            "squash": squash,
            "limit": limit,
            "clip": clip,
        }
        self.requires_grad_(False)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` for an observation ``(*B, O)``."""
        value = observation.to(self.low.dtype)
        if self.normaliser is not None:
            mean, std = self.normaliser
            value = ((value - mean) / std).clamp(-self.form["clip"], self.form["clip"])
        activate = getattr(nn.functional, self.form["activation"])
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            value = nn.functional.linear(value, weight, bias)
            value = value if index == last else activate(value)
        if self.form["squash"]:
            value = value.clamp(-self.form["limit"], self.form["limit"]).tanh()
            value = self.low + (self.high - self.low) * (value + 1) / 2
        return value.clamp(self.low, self.high).to(observation.dtype)

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        return self.weights[0].shape[1]


def save_policy(file: Path, policy: StoredPolicy, description: Mapping[str, Any]) -> None:
    """Write a policy, its weights in half precision; ``description`` says how it was made."""
    kept = {name: value.half() for name, value in policy.named_parameters()}
    kept |= dict(policy.named_buffers())
    save_tensors(Path(file), kept, {**description, "kind": "policy", "form": policy.form})


def load_policy(file: Path) -> tuple[StoredPolicy, dict[str, Any]]:
    """Return a stored policy and its description.

    Raises:
        ConfigurationError: if there is no such file.
        ArtefactError: if it is damaged, or holds something else.
    """
    with refusing(f"{file}: contains no policy; make one with save_policy", ArtefactError):
        tensors, description = read_tensors(Path(file))
        if description["kind"] != "policy":
            raise KeyError("kind")
        count = range(sum(name.startswith("weights") for name in tensors))
        layers = [(tensors[f"weights.{index}"], tensors[f"biases.{index}"]) for index in count]
        box, normaliser = (tensors["low"], tensors["high"]), tensors.get("normaliser")
        policy = StoredPolicy(layers, *box, normaliser=normaliser, **description["form"])
    return policy, description


class PolicyPlanner(TensorDictModuleBase):
    """A stored policy in the place of a planner: it acts on what it sees, and plans nothing.

    Noise is added while TorchRL explores, as its collectors do: without it a model cannot learn
    from the policy's data what other actions would have done.

    In an :class:`~afm_rl.dynamics.Oracle` it sends the actions whose effects, under the regime
    of the oracle, are nearest to the policy's: a reference for corrections. If the policy's action
    is not finite, it is passed on, and :class:`~afm_rl.transforms.Guard` repeats the last one.

    Args:
        env: the planning environment: where state and action are, the action bounds, and what a
            policy sees of a state.
        file: written by :func:`save_policy`.

    Raises:
        ConfigurationError: if there is no such file, or the policy's sizes do not fit.
        ArtefactError: if the file is damaged, or holds something else.
    """

    @options("planner")
    def __init__(
        self,
        env: PlanningEnv,
        file: Annotated[str | Path | None, "file that afm_rl.planning.save_policy wrote"] = None,
        noise: Annotated[
            NonNegative, "noise of actions while data are collected, in half ranges"
        ] = 0.1,
    ) -> None:
        super().__init__()
        self.env, self.noise = env, noise
        self.action_spec = env.full_action_spec[env.action_keys[0]]
        self.in_keys, self.out_keys = [env.observation_key], [env.action_keys[0]]
        if not isinstance(file, str | Path):
            raise ConfigurationError(
                f"planner.file={file!r}: expected a file that save_policy wrote"
            )
        try:
            self.policy, _ = load_policy(Path(file).expanduser())
        except (ConfigurationError, ArtefactError) as error:
            raise type(error)(f"planner.file: {error}") from error
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

    def _seen(self, state: Tensor) -> Tensor:
        return state if self.env.observe is None else self.env.observe(state)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the policy's action, with noise while TorchRL explores."""
        state, box = tensordict.get(self.env.observation_key), self.action_spec.space
        action = self.policy(self._seen(state))
        if exploration_type() == ExplorationType.RANDOM:
            action = action + 0.5 * self.noise * (box.high - box.low) * torch.randn_like(action)
        if isinstance(self.env.dynamics, Oracle):
            action = self.env.dynamics.command(state, action, box.low, box.high)
        return tensordict.set(self.out_keys[0], self.action_spec.project(action))
