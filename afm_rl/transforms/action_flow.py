"""The transform between planner and environment."""

from __future__ import annotations

import os

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import FrameSkipTransform, Transform

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_flag, check_instance
from afm_rl.flow import Context, Correction, Corrector, Window
from afm_rl.keys import as_key


class ActionFlowTransform(Transform):
    r"""Action Flow Matching: the planned action goes in, the action that does it comes out.

    On the way to the environment the transform looks at its window of past transitions,
    asks the *present* dynamics model what each executed action was worth, and, while the
    model is misaligned, replaces the planned action by the flow's answer (paper, section
    IV-D). On the way back it adds the transition to the window. It never learns and never
    changes the model, which it shares with planner and updater.

    The whole memory lives in the tensordict, under ``prefix``: every mission of a batch has
    its own, and resets, branches and resumed rollouts are exact. Of use to others are

    * ``(prefix, "planned_action")`` and ``(prefix, "executed_action")``: the root action
      stays the planned one, so losses should read the executed one,
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
        widen: let planners know of effects beyond the action box, if the model can foresee them.

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
        widen: bool = True,
    ) -> None:
        check_instance("transform.model", model, DynamicsModel)
        check_instance("transform.flow", flow, Corrector)
        observation_key, action_key = as_key(observation_key), as_key(action_key)
        super().__init__(in_keys=[observation_key], in_keys_inv=[action_key])
        if flow.action_size != model.action_size:
            raise ConfigurationError(
                f"flow: made for {flow.action_size} actions, but the dynamics model has "
                f"{model.action_size}"
            )
        self.__dict__["model"] = model  # shared with planner and updater, so not registered
        self.flow = flow
        self.observation_key = observation_key
        self.action_key = action_key
        self.prefix = as_key(prefix)
        self.enabled = check_flag("transform.enabled", enabled)
        self.widen = check_flag("transform.widen", widen)

    def key(self, *names: str) -> NestedKey:
        """Return the key of an entry of the memory."""
        return unravel_key((self.prefix, *names))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the tensordict as it is: a replay buffer or a policy has no step to watch."""
        return tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.parent is None:  # inside a replay buffer: nothing to execute
            return tensordict
        planned = tensordict.get(self.action_key)
        memory = self._recall(tensordict)
        window = Window(*(memory.get(("window", name)) for name in Window._fields))
        last = Context(*(memory.get(name) for name in Context._fields))
        with torch.no_grad():
            context = self.flow.context(window, self.model, last)
            executed, spread, reach = self._correct(context, memory.get("state"), planned)
        executed = self.parent.full_action_spec[self.action_key].project(executed)
        memory = memory.clone(recurse=False)
        memory.update(context._asdict())
        memory.set("planned_action", planned)
        memory.set("executed_action", executed)
        memory.set("spread", spread)
        memory.set("reach", reach)
        return tensordict.set(self.prefix, memory).set(self.action_key, executed)

    def _correct(self, context: Context, state: Tensor, planned: Tensor) -> Correction:
        """Return actions, spreads and reaches; those of the flow where the model is misaligned."""
        executed, spread = planned.clone(), torch.zeros_like(planned)
        reach = self._box(planned)
        use = context.misaligned & self.enabled
        if not bool(use.any()):
            return Correction(executed, spread, reach)
        shown = Context(*(part[use] for part in context))
        found = self.flow.correct(shown, state[use], planned[use])
        sound = found.action.isfinite().all(-1, keepdim=True)
        executed[use] = torch.where(sound, found.action, planned[use])
        spread[use] = torch.where(sound, found.spread, 0.0)
        if found.reach is not None and self.widen and self.model.extrapolates:
            # Never a smaller box: what cannot be had the flow cuts, and it knows better.
            low, high = torch.where(sound.unsqueeze(-1), found.reach, 0.0).unbind(-2)
            least, most = reach[use].unbind(-2)
            widened = [torch.minimum(least, low), torch.maximum(most, high)]
            reach[use] = torch.stack(widened, -2)
        return Correction(executed, spread, reach)

    def _box(self, like: Tensor) -> Tensor:
        """Return the action box for actions ``(*B, A)``: ``(*B, 2, A)``."""
        space = self.parent.full_action_spec[self.action_key].space
        return torch.stack([space.low.expand_as(like), space.high.expand_as(like)], -2).to(like)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        memory = tensordict.get(self.prefix).clone(recurse=False)
        state, next_state = memory.get("state"), next_tensordict.get(self.observation_key)
        planned, executed = memory.get("planned_action"), memory.get("executed_action")
        valid = next_state.isfinite().all(-1) & state.isfinite().all(-1)
        newest = Window(state, planned, executed, next_state, valid)
        window = memory.get("window").clone(recurse=False)
        for name, value in newest._asdict().items():
            kept = window.get(name).narrow(valid.dim(), 1, self.flow.window - 1)
            window.set(name, torch.cat([kept, value.unsqueeze(valid.dim())], valid.dim()))
        memory.set("window", window)
        memory.set("state", next_state.clone())
        return next_tensordict.set(self.prefix, memory)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_process()
        state = tensordict_reset.get(self.observation_key)
        memory = self._memory_spec(state.shape[:-1], state.dtype).to(state.device).zero()
        memory.set("reach", self._box(memory.get("planned_action")))
        return tensordict_reset.set(self.prefix, memory.set("state", state.clone()))

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

    def _memory_spec(self, batch: torch.Size, dtype: torch.dtype) -> Composite:
        """Return the specs of the memory for a batch shape."""
        states, actions, window = self.model.state_size, self.model.action_size, self.flow.window

        def real(*shape: int) -> Unbounded:
            return Unbounded((*batch, *shape), dtype=dtype)

        def flag(*shape: int) -> Binary:
            return Binary(shape=(*batch, *shape), dtype=torch.bool)

        rows = Composite(
            state=real(window, states),
            planned=real(window, actions),
            executed=real(window, actions),
            next_state=real(window, states),
            valid=flag(window),
            shape=batch,
        )
        return Composite(
            state=real(states),
            window=rows,
            pairs=real(window, self.flow.pair_size),
            evidence=real(self.flow.evidence_size),
            features=real(self.flow.feature_size),
            surprise=real(),
            misaligned=flag(),
            planned_action=real(actions),
            executed_action=real(actions),
            spread=real(actions),
            reach=real(2, actions),
            shape=batch,
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
        spec[self.prefix] = self._memory_spec(spec.shape, dtype).to(spec.device)
        return spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory."""
        return self._with_memory(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Add the memory: it is an input of the next step."""
        return self._with_memory(state_spec)
