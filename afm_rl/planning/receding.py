"""Planners whose plan travels with the tensordict."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules.planners.common import MPCPlannerBase

from afm_rl.compiling.devices import moved
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.planning.primer import ZeroPrimer
from afm_rl.spaces.keys import as_key


def action_spec_of(env: EnvBase) -> TensorSpec:
    """Return the spec of an environment's action, whatever its key.

    Raises:
        ConfigurationError: if there are several actions.
    """
    if len(check_instance("planner.env", env, EnvBase).action_keys) != 1:
        raise ConfigurationError(
            f"planner: {type(env).__name__} takes the actions {env.action_keys}; expected one"
        )
    return env.full_action_spec[env.action_key]


class RecedingHorizonPlanner(MPCPlannerBase):
    """A planner that starts from its previous plan, which it keeps in the tensordict.

    So every mission of a batch has its own, resets start afresh, and branches are exact: append
    :meth:`make_tensordict_primer` to the environment. Without it each plan starts cold, and a
    warning is given once.

    Args:
        env: batch-unlocked environment to plan in.
        memory: entries that are kept, with their shapes.
        action_key: where the action goes.
    """

    def __init__(
        self,
        env: EnvBase,
        memory: Mapping[NestedKey, Sequence[int]],
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__(env, action_key=as_key(action_key))
        self.action_spec = action_spec_of(env)
        self.action_key = as_key(action_key)
        self.memory = {as_key(key): tuple(shape) for key, shape in memory.items()}
        self.next_memory = [unravel_key(("next", key)) for key in self.memory]
        self.out_keys = [self.action_key, *self.next_memory]
        self._told = False

    def _apply(
        self, fn: Callable[[Tensor], Tensor], recurse: bool = True
    ) -> RecedingHorizonPlanner:
        """Move the spec too."""
        self.action_spec = moved(self.action_spec, fn)
        return super()._apply(fn, recurse)

    @abstractmethod
    def _plan(self, td: TensorDictBase) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the action ``(*B, A)`` and the new memory, each entry ``(*B, *shape)``."""

    def make_tensordict_primer(self) -> ZeroPrimer:
        """Return the transform that puts an empty memory into every reset."""
        dtype = self.action_spec.dtype
        pairs = self.memory.items()
        return ZeroPrimer(Composite({key: Unbounded(shape, dtype=dtype) for key, shape in pairs}))

    def forward(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs,
    ) -> TensorDictBase:
        """Write the action and the next memory."""
        action, memory = self._plan(tensordict)
        out = tensordict if tensordict_out is None else tensordict_out
        for key, value in zip(self.next_memory, memory, strict=True):
            out.set(key, value)
        return out.set(self.action_key, self._allowed(action, tensordict))

    def _allowed(self, action: Tensor, td: TensorDictBase) -> Tensor:
        """Return the nearest action that may be planned."""
        if not isinstance(self.action_spec, Bounded):
            return self.action_spec.project(action)
        return action.clamp(self.action_spec.space.low, self.action_spec.space.high)

    def planning(self, td: TensorDictBase) -> Tensor:
        """Return the action ``(*B, A)`` without writing anything."""
        return self._plan(td)[0]

    def _recall(self, td: TensorDictBase) -> list[Tensor]:
        """Return the memory, zeros where there is none."""
        found = [td.get(key, None) for key in self.memory]
        if all(entry is not None for entry in found):
            return found
        if not self._told:
            warnings.warn(
                f"planner: no {' or '.join(map(repr, self.memory))} in the tensordict, so every "
                "plan starts cold; append planner.make_tensordict_primer() to the environment",
                stacklevel=5,
            )
            self._told = True
        like = {"device": self.action_spec.device, "dtype": self.action_spec.dtype}
        return [torch.zeros((*td.batch_size, *shape), **like) for shape in self.memory.values()]
