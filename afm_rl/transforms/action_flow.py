"""The transform between planner and environment."""

from __future__ import annotations

import os

from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import Composite
from torchrl.envs import FrameSkipTransform, Transform

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError
from afm_rl.flow import Corrector
from afm_rl.keys import as_key
from afm_rl.transforms.memory import begin, check_parts, correct, memory_spec, observe


class ActionFlowTransform(Transform):
    r"""Action Flow Matching: the planned action goes in, the action that does it comes out.

    On the way to the environment the transform looks at its window of past transitions,
    asks the dynamics model what each executed action was worth (of a model that learns, the
    *present* one about the latest transitions again), and, while the model is misaligned,
    replaces the planned action by the flow's answer (paper, section IV-D). On the way back it
    adds the transition to the window. It never learns and never changes the model, which it
    shares with planner and updater.

    The whole memory lives in the tensordict, under ``prefix``: every mission of a batch has
    its own, and resets, branches and resumed rollouts are exact. Of use to others are

    * ``(prefix, "planned_action")`` and ``(prefix, "executed_action")``: the root action
      stays the planned one, so losses should read the executed one,
    * ``(prefix, "expected_action")``: what the executed action is expected to be worth; where
      nothing is corrected, itself,
    * ``(prefix, "misaligned")``: was the action corrected?
    * ``(prefix, "surprise")``: the misalignment, in the unit of the flow's gate,
    * ``(prefix, "spread")``: standard deviation of the flow's samples, per action,
    * ``(prefix, "reach")``: lowest and highest effect that an action can have, ``(*B, 2, A)``, at
      least the action box: for planners that can plan beyond it.

    Put it first in a ``Compose``: what follows may rescale the observation under another key
    and the action. It needs the state as the model knows it in ``observation_key``.

    Args:
        model: dynamics model, shared (it does not become part of the state dict).
        flow: the correction; owned.
        observation_key: the state.
        action_key: the action.
        prefix: where the memory is kept.
        enabled: switch the correction off to watch only (see :attr:`enabled`).
        extend_action_box: let planners know of effects beyond the action box, if the model can
            foresee them.

    >>> import torch
    >>> from torchrl.envs import TransformedEnv
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.flow import ContextFlow
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    >>> world = PlanningEnv(Dubins(), GoalDistance(), low, high)  # any TorchRL env will do
    >>> env = TransformedEnv(world, ActionFlowTransform(Dubins(), ContextFlow(low, high)))
    >>> env.rollout(5)["next", "afm", "executed_action"].shape
    torch.Size([5, 2])
    """

    flow: Corrector

    def __init__(
        self,
        model: DynamicsModel,
        flow: Corrector,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        prefix: NestedKey = "afm",
        enabled: bool = True,
        extend_action_box: bool = True,
    ) -> None:
        check_parts("transform", model, flow, enabled, extend_action_box)
        observation_key, action_key = as_key(observation_key), as_key(action_key)
        super().__init__(in_keys=[observation_key], in_keys_inv=[action_key])
        self.__dict__["model"] = model  # shared with planner and updater, so not registered
        self.flow = flow
        self.observation_key = observation_key
        self.action_key = action_key
        self.prefix = as_key(prefix)
        self.enabled, self.extend_action_box = enabled, extend_action_box

    def key(self, *names: str) -> NestedKey:
        """Return the key of an entry of the memory."""
        return unravel_key((self.prefix, *names))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the tensordict as it is: a replay buffer or a policy has no step to watch."""
        return tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # inside a replay buffer: nothing to execute
            return tensordict
        memory = correct(
            self._recall(tensordict),
            tensordict.get(self.action_key),
            self.model,
            self.flow,
            self.parent.full_action_spec[self.action_key],
            self.enabled,
            self.extend_action_box,
        )
        tensordict.set(self.action_key, memory.get("executed_action"))
        return tensordict.set(self.prefix, memory)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        memory = observe(tensordict.get(self.prefix), next_tensordict.get(self.observation_key))
        return next_tensordict.set(self.prefix, memory)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_process()
        state = tensordict_reset.get(self.observation_key)
        action_spec = self.parent.full_action_spec[self.action_key]
        memory = begin(self.model, self.flow, state, action_spec)
        return tensordict_reset.set(self.prefix, memory)

    def _recall(self, tensordict: TensorDictBase) -> TensorDictBase:
        memory = tensordict.get(self.prefix, None)
        if memory is None:
            raise KeyError(
                f"ActionFlowTransform: no {self.prefix!r} in the tensordict; start from "
                "env.reset(), and carry its entries on"
            )
        return memory

    def _check_process(self) -> None:
        """Refuse a copy of a model that learns in another process: it would stay behind."""
        if self.model.taught_in not in (None, os.getpid()):
            raise ConfigurationError(
                "ActionFlowTransform: the dynamics model learns in another process, so that its "
                "copy in this one would never change; put the transform around ParallelEnv "
                "instead of inside, use a Collector instead of MultiSyncCollector, or a model "
                "that does not learn"
            )

    def _check_order(self) -> None:
        """Refuse to stand before a frame skip, which would have each frame corrected again."""
        chain = getattr(getattr(self.container, "transform", None), "transforms", [])
        for other in reversed(chain):
            if other is self:
                return
            if isinstance(other, FrameSkipTransform):
                raise ConfigurationError(
                    "ActionFlowTransform: a FrameSkipTransform follows it, and would have actions "
                    "that are corrected already corrected again; put FrameSkipTransform before "
                    "it, and give it a model of the whole stride"
                )

    def _with_memory(self, spec: Composite) -> Composite:
        self._check_order()
        found = self.parent.full_observation_spec
        dtype = found[self.observation_key].dtype
        if found[self.observation_key].shape[-1] != self.model.state_size:
            raise ConfigurationError(
                f"observation_key={self.observation_key!r}: holds "
                f"{found[self.observation_key].shape[-1]} numbers, but the dynamics model's "
                f"state has {self.model.state_size}"
            )
        memory = memory_spec(self.model, self.flow, spec.shape, dtype)
        spec[self.prefix] = memory.to(spec.device)
        return spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory."""
        return self._with_memory(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Add the memory: it is an input of the next step."""
        return self._with_memory(state_spec)
