"""A transform whose state is carried in the tensordict."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from afm_rl.errors import ConfigurationError
from afm_rl.spaces.keys import as_key


class StatefulTransform(Transform, ABC):
    """Stands between policy and environment, and remembers under ``prefix``.

    Each environment of a batch has a memory of its own, and resets, branches and resumed rollouts
    are exact: the memory is an observation, and an input of the next step. In a replay buffer or a
    policy, where nothing is executed, it does nothing.

    Args:
        observation_key: the state.
        action_key: the action.
        prefix: where the memory is kept.

    Raises:
        KeyError: at a step, if the tensordict holds no memory: begin with ``env.reset()``.
    """

    def __init__(
        self, observation_key: NestedKey, action_key: NestedKey, prefix: NestedKey
    ) -> None:
        self.observation_key, self.action_key = as_key(observation_key), as_key(action_key)
        super().__init__(in_keys=[self.observation_key], in_keys_inv=[self.action_key])
        self.prefix = as_key(prefix)

    def key(self, *names: str) -> NestedKey:
        """Return the key of an entry."""
        return unravel_key((self.prefix, *names))

    @abstractmethod
    def act(self, tensordict: TensorDictBase, memory: Any) -> TensorDictBase:
        """Put the action to execute, and what is remembered of it, into a tensordict."""

    @abstractmethod
    def memory_spec(self, spec: Composite) -> Composite:
        """Return the specs of the memory; ``spec`` is of all that stands beside it."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict

    def recall(self, tensordict: TensorDictBase) -> Any:
        """Return what is remembered up to a tensordict; None if it holds nothing of it."""
        return tensordict.get(self.prefix, None)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:
            return tensordict
        memory = self.recall(tensordict)
        if memory is None:
            raise KeyError(
                f"{type(self).__name__}: no {self.prefix!r} in the tensordict; start from "
                "env.reset(), and carry its entries on"
            )
        return self.act(tensordict, memory)

    def empty(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return a memory of zeros for what a tensordict holds."""
        spec = self.memory_spec(Composite(shape=tensordict.batch_size))
        return spec.to(tensordict.get(self.observation_key).device).zero()

    def specs(self, vectors: bool = False) -> tuple[TensorSpec, TensorSpec]:
        """Return the specs of one action and of one observation.

        Args:
            vectors: must observations be vectors, too?

        Raises:
            ConfigurationError: for actions that are no vectors of real numbers.
        """
        action = self.parent.full_action_spec_unbatched[self.action_key]
        seen = self.parent.full_observation_spec_unbatched[self.observation_key]
        if not action.dtype.is_floating_point or action.ndim != 1 or vectors and seen.ndim != 1:
            raise ConfigurationError(
                f"{self.action_key!r}, {self.observation_key!r}: expected vectors of real numbers, "
                f"got {action} and {seen}"
            )
        return action, seen

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return self.transform_state_spec(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Return the spec with that of the memory, which is an observation and an input."""
        spec = state_spec
        check_free(type(self).__name__, self.prefix, spec)
        seen, path = self.parent.full_observation_spec, self.key("memory")[:-2]
        for node in (path[: k + 1] for k in range(len(path))):
            if spec.get(node, None) is None:  # of as many agents as are observed there
                spec[node] = Composite(shape=seen.get(node, spec).shape, device=spec.device)
        spec[self.prefix] = self.memory_spec(spec).to(spec.device)
        return spec


def check_free(owner: str, prefix: NestedKey, spec: Composite) -> None:
    """Refuse a prefix that stands in a spec already: two would write each other's memory."""
    if spec.get(prefix, None) is not None:
        raise ConfigurationError(
            f"{owner}: prefix={prefix!r}: taken, by the environment or another transform; give "
            "each a prefix of its own"
        )
