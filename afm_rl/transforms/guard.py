"""The last thing before an environment: only actions that can be executed pass."""

from __future__ import annotations

import math

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from afm_rl.errors import ConfigurationError, check_number, warn
from afm_rl.faults import PATIENCE, check_numbers, count_repeats, safe_action, trusted
from afm_rl.spaces.keys import as_key
from afm_rl.transforms.stateful import StatefulTransform


class Guard(StatefulTransform):
    r"""Finite actions inside the action spec, whatever came before; and a look at the readings.

    .. math:: a_\mathrm{exec} = \min(\max(a, l), h), \quad
              \text{the last executed action where } a \text{ is not finite}

    The guard knows no model, planner or corrector. Put it *first* in a ``Compose``: on the way
    to the environment it is then the last. At the start of an episode the last executed action
    is the one of the spec that is nearest to zero. A reading of real numbers gets the type of the
    observation spec; anything else, or of another shape, becomes NaN, with a warning that says so.

    The memory lives in the tensordict, under ``prefix``, one per environment of a batch:

    * ``(prefix, "executed_action")`` ``(*B, A)``: what the environment was given,
    * ``(prefix, "held")`` ``(*B)``: the action was not finite, and the last one was held,
    * ``(prefix, "sound")`` ``(*B)``: readings at both ends of the last transition are finite and
      not stale (:mod:`afm_rl.faults`); use it as ``mask`` of an updater,
    * ``(prefix, "repeats")`` ``(*B)``: how often in a row the present reading has been sent again.

    Args:
        observation_key: the state's reading, ``(*B, S)``.
        action_key: the action, ``(*B, A)``, of a spec of real numbers.
        prefix: where the memory is kept.
        stamp_key: time of a reading, ``(*B)`` or ``(*B, 1)``; None where there is none.
        patience: repetitions of a reading that count as a stale sensor; not used with stamps.

    Raises:
        ConfigurationError: for a setting that cannot be used, or an action of another shape.

    >>> from torchrl.envs import Compose, GymEnv, TransformedEnv
    >>> env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(Guard()))
    >>> td = env.reset()
    >>> td["action"] = torch.tensor([50.0])
    >>> env.step(td)["next", "guard", "executed_action"]
    tensor([2.])
    """

    def __init__(
        self,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        prefix: NestedKey = "guard",
        stamp_key: NestedKey | None = None,
        patience: float = PATIENCE,
    ) -> None:
        super().__init__(observation_key, action_key, prefix)
        self.stamp_key = None if stamp_key is None else as_key(stamp_key)
        if patience != math.inf:
            check_number("patience", patience, low=0.0)
        self.patience = math.inf if stamp_key is not None else patience

    def act(self, tensordict: TensorDictBase, memory: TensorDictBase) -> TensorDictBase:
        """Let only an action pass that can be executed."""
        last = memory.get("executed_action")
        action = check_numbers(self.action_key, tensordict.get(self.action_key, None), last.shape)
        space = self._action_spec.space
        executed, held = safe_action(action, space.low, space.high, last)
        memory = memory.clone(recurse=False).set("executed_action", executed).set("held", held)
        return tensordict.set(self.prefix, memory).set(self.action_key, executed)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        memory = tensordict.get(self.prefix).clone(recurse=False)
        last, count = memory.get("reading"), memory.get("repeats")
        reading = self._reading(next_tensordict, last)
        next_tensordict.set(self.observation_key, reading)
        stamps = self._stamp(next_tensordict), memory.get("stamp", None)
        repeats = count_repeats(reading, last, count, *stamps)
        sound = trusted(last, count, self.patience) & trusted(reading, repeats, self.patience)
        memory.update({"reading": reading.clone(), "repeats": repeats, "sound": sound})
        if self.stamp_key is not None:
            memory.set("stamp", stamps[0])
        return next_tensordict.set(self.prefix, memory)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        memory = self.empty(tensordict_reset)
        space = self._action_spec.space
        rest, _ = safe_action(memory["executed_action"], space.low, space.high, torch.zeros(()))
        memory.update({"executed_action": rest, "sound": torch.ones_like(memory["sound"])})
        memory.set("reading", self._reading(tensordict_reset, memory["reading"]).clone())
        if self.stamp_key is not None:
            memory.set("stamp", self._stamp(tensordict_reset))
        return tensordict_reset.set(self.prefix, memory)

    def _reading(self, tensordict: TensorDictBase, like: Tensor) -> Tensor:
        """Return the reading in the type of ``like`` ``(*B, S)``; NaN if it is no such numbers."""
        found = tensordict.get(self.observation_key)
        try:
            return check_numbers(self.observation_key, found, like.shape).to(like.dtype)
        except ConfigurationError as error:
            warn(f"{error}: taken for no reading")
            return torch.full_like(like, torch.nan)

    def _stamp(self, tensordict: TensorDictBase) -> Tensor | None:
        if self.stamp_key is None:
            return None
        return tensordict.get(self.stamp_key).reshape(tensordict.batch_size).clone()

    @property
    def _action_spec(self) -> TensorSpec:
        return self.parent.full_action_spec[self.action_key]

    def memory_spec(self, spec: Composite) -> Composite:
        """Return the specs of the memory."""
        batch, (action, reading) = spec.shape, self.specs(vectors=True)
        found = Composite(
            executed_action=Unbounded((*batch, *action.shape), dtype=action.dtype),
            reading=Unbounded((*batch, *reading.shape), dtype=reading.dtype),
            repeats=Unbounded(batch, dtype=torch.int64),
            held=Binary(shape=batch, dtype=torch.bool),
            sound=Binary(shape=batch, dtype=torch.bool),
            shape=batch,
        )
        if self.stamp_key is not None:
            stamp = self.parent.full_observation_spec_unbatched[self.stamp_key]
            found["stamp"] = Unbounded(batch, dtype=stamp.dtype)
        return found
