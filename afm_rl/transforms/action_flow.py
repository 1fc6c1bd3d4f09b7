"""The transform between planner and environment."""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import FrameSkipTransform

from afm_rl.correction import ActionFlow, Corrector
from afm_rl.correction.late import arrival
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_choice, check_flag, check_instance
from afm_rl.spaces.keys import as_key, as_keys
from afm_rl.transforms.carried import CarriedTransform
from afm_rl.transforms.memory import (
    LATE,
    begin,
    correct,
    corrector_for,
    entries_spec,
    observe,
    warn_of_old,
)


class ActionFlowTransform(CarriedTransform):
    r"""Action Flow Matching: the planned action goes in, the action that does it comes out.

    On the way to the environment the transform asks the dynamics model what the last executed
    actions did (of a model that learns, the *present* one about the newest transitions again)
    and, while the model is misaligned, replaces the planned action by the corrector's answer
    (paper, section IV-D). On the way back it adds the transition to its memory. It never learns
    and never changes the model, which it shares with planner and updater.

    All that it keeps lives in the tensordict, under ``prefix``: every mission of a batch has its
    own, and resets, branches and resumed rollouts are exact. Of use to others are

    * ``(prefix, "planned_action")`` and ``(prefix, "executed_action")`` ``(*B, A)``: the root
      action stays the planned one, so losses should read the executed one,
    * ``(prefix, "predicted_effect")`` ``(*B, A)``: the effect that the executed action is
      predicted to have; where nothing is corrected, itself,
    * ``(prefix, "misaligned")`` ``(*B)``: does the model misjudge actions, so that they are
      corrected (with ``enabled=False``: so that they would be)?
    * ``(prefix, "observation")`` and ``(prefix, "arrival")`` ``(*B, S)``: the measured state, and
      the one in which the next action will act; while no action is late, the same,
    * ``(prefix, "delay")`` ``(*B)``: in how many steps that will be, an integer; 0 at once, and
      with ``enabled=False``,
    * ``(prefix, "innovation")`` ``(*B)``: the misalignment, in the unit of the gate,
    * ``(prefix, "spread")`` ``(*B, A)``: standard deviation of the flow's samples,
    * ``(prefix, "noise")`` ``(*B, A)``: standard deviation of effects that nothing explains,
    * ``(prefix, "effect_bounds")`` ``(*B, 2, A)``: lowest and highest effect that an action can
      have, at least the action box: for planners that can plan beyond it.

    ``(prefix, "memory")`` ``(*B, P)`` is the corrector's own; logs can drop it:
    ``data.exclude(("afm", "memory"), ("next", "afm", "memory"))``.

    Put it first in a ``Compose``: what follows may rescale the observation under another key
    and the action. It needs the state as the model knows it.

    Args:
        model: dynamics model, shared (it does not become part of the state dict).
        corrector: the correction, owned; None: the universal
            :class:`~afm_rl.correction.ActionFlow` for the environment's action box.
        in_keys: the state; ``["observation"]`` if None.
        in_keys_inv: the action; ``["action"]`` if None.
        prefix: where the entries are kept.
        enabled: False to watch only.
        extend_action_box: let planners know of effects beyond the action box, if the model can
            predict them.
        reported_key: where the environment reports the action ``(*B, A)`` that its actuators gave
            in a step, if that is known and not what they were sent: motors that lag.
        late: what policies find under ``in_keys`` while actions act late: ``"predict"``, the state
            in which the next action will act; ``"leave"``, the measured one.
        delay: steps from an action to its effect that are known, one number or one per axis.
        belief: keep ``(prefix, "belief")`` ``(*B, C, A)``, too: how probable the ``causes`` of the
            :class:`~afm_rl.correction.ActionFlow` are, by axis.

    Raises:
        ConfigurationError: for parts that do not fit each other, also when it is put around an
            environment.

    >>> import torch
    >>> from torchrl.envs import TransformedEnv
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance, PlanningEnv
    >>> low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    >>> world = PlanningEnv(Dubins(), GoalDistance(), low, high)  # any TorchRL env will do
    >>> env = TransformedEnv(world, ActionFlowTransform(Dubins()))
    >>> env.rollout(5)["next", "afm", "executed_action"].shape
    torch.Size([5, 2])
    """

    essential = ("memory",)

    def __init__(
        self,
        model: DynamicsModel,
        corrector: Corrector | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        in_keys_inv: Sequence[NestedKey] | None = None,
        prefix: NestedKey = "afm",
        enabled: bool = True,
        extend_action_box: bool = True,
        reported_key: NestedKey | None = None,
        late: str = "predict",
        delay: int | Sequence[int] | None = None,
        belief: bool = False,
    ) -> None:
        self.delay, self.belief = delay, check_flag("transform.belief", belief)
        self.late = check_choice("transform.late", late, LATE)
        state = _one_key("in_keys", ["observation"] if in_keys is None else in_keys)
        action = _one_key("in_keys_inv", ["action"] if in_keys_inv is None else in_keys_inv)
        super().__init__(state, action, prefix)
        self.__dict__["model"] = check_instance("transform.model", model, DynamicsModel)
        if corrector is not None:
            corrector = corrector_for("transform", model, corrector, None, delay)
        self._corrector = corrector
        self.enabled = check_flag("transform.enabled", enabled)
        self.extend_action_box = check_flag("transform.extend_action_box", extend_action_box)
        self.reported_key = None if reported_key is None else as_key(reported_key)

    @property
    def corrector(self) -> Corrector:
        """The correction; the universal one is made for the environment's action box."""
        if self._corrector is None:
            if self.parent is None:
                raise ConfigurationError(
                    "ActionFlowTransform.corrector: the action box is not known yet; put the "
                    "transform around an environment first, or give a corrector"
                )
            self._corrector = corrector_for(
                "transform", self.model, None, self._action_spec, self.delay
            )
        return self._corrector

    @property
    def _action_spec(self):
        return self._entry("in_keys_inv", self.parent.full_action_spec)

    def _entry(self, name: str, specs: Composite) -> TensorSpec:
        """Return the environment's spec of ``in_keys`` or ``in_keys_inv``."""
        (key,) = getattr(self, name)
        found = specs.get(key, None)
        if found is None:
            raise ConfigurationError(
                f"ActionFlowTransform: {name}=[{key!r}]: the environment has no such entry, but "
                f"{list(specs.keys(True, True))}"
            )
        return found

    def act(self, tensordict: TensorDictBase, memory: Tensor) -> TensorDictBase:
        """Replace the planned action by the corrected one."""
        warn_of_old(tensordict, self.prefix)
        planned = tensordict.get(self.action_key, None)
        entries = correct(
            memory,
            planned,
            self.model,
            self.corrector,
            self._action_spec,
            self.enabled,
            self.extend_action_box,
            self.action_key,
        )
        tensordict.set(self.action_key, entries.get("executed_action").to(planned.dtype))
        kept = tensordict.get(self.prefix).select("observation", "arrival", "delay")
        # Environments without a state of their own go on from what is under this key.
        tensordict.set(self.observation_key, kept.get("observation"))
        return tensordict.set(self.prefix, self._believed(entries.update(kept)))

    def _believed(self, entries: TensorDictBase) -> TensorDictBase:
        """Return the entries with the belief, if it is asked for."""
        if self.belief:
            entries.set("belief", self._believer.belief_in(entries.get("memory")))
        return entries

    @property
    def _believer(self) -> ActionFlow:
        name = "transform.belief=True: transform.corrector"
        return check_instance(name, self.corrector, ActionFlow)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        entries = dict(tensordict.get(self.prefix).items())
        memory = entries["memory"]
        if self.reported_key is not None:
            given = next_tensordict.get(self.reported_key).to(memory.dtype)
            memory = self.corrector.reported(memory, given)
        state = next_tensordict.get(self.observation_key, None)
        memory = observe(memory, state, self.model, self.corrector, self.observation_key)
        entries |= {"memory": memory, **self._seen(memory, state)}
        # Of the device that the next tensordict names: else every entry is moved to where it is.
        device, batch = next_tensordict.device, next_tensordict.batch_size
        self._show(next_tensordict, entries["arrival"])
        return next_tensordict.set(self.prefix, TensorDict(entries, batch, device=device))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_process()
        state = tensordict_reset.get(self.observation_key, None)
        if state is None:
            self._entry("in_keys", self.parent.full_observation_spec)
        entries = begin(self.corrector, state, self._action_spec)
        entries.update(self._seen(entries.get("memory"), state))
        self._show(tensordict_reset, entries.get("arrival"))
        return tensordict_reset.set(self.prefix, self._believed(entries))

    def _seen(self, memory: Tensor, measured: Tensor) -> dict[str, Tensor]:
        """Return the entries of the present state and of that in which the next action acts."""
        there, steps = arrival(self.corrector, memory, self.model)
        delay = steps if self.enabled else torch.zeros_like(steps)
        there = torch.where((delay > 0).unsqueeze(-1), there.to(measured.dtype), measured)
        return {"observation": measured.clone(), "arrival": there, "delay": delay}

    def _show(self, tensordict: TensorDictBase, there: Tensor) -> None:
        """Let policies find the state in which their action will act."""
        if self.late == "predict":
            tensordict.set(self.observation_key, there)

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

    def memory_spec(self, spec: Composite, executed: bool) -> Composite:
        """Return the specs of the entries."""
        self._check_order()
        found = self._entry("in_keys", self.parent.full_observation_spec)
        if not found.shape or found.shape[-1] != self.model.state_size:
            raise ConfigurationError(
                f"ActionFlowTransform: in_keys={self.in_keys}: of the shape "
                f"{tuple(found.shape)}, but the dynamics model's state has "
                f"{self.model.state_size} numbers"
            )
        entries = entries_spec(self.corrector, self.model.state_size, spec.shape, found.dtype)
        size = (*spec.shape, self.model.state_size)
        entries["observation"] = Unbounded(size, dtype=found.dtype)
        entries["arrival"] = Unbounded(size, dtype=found.dtype)
        entries["delay"] = Unbounded(spec.shape, dtype=torch.long)
        if self.belief:
            size = (*spec.shape, len(self._believer.causes), self.corrector.action_size)
            entries["belief"] = Unbounded(size, dtype=found.dtype)
        return entries


def _one_key(name: str, keys: Sequence[NestedKey]) -> NestedKey:
    found = as_keys([keys] if isinstance(keys, str) else keys)
    if len(found) != 1:
        raise ConfigurationError(f"ActionFlowTransform: {name}={keys!r}: expected one key")
    return found[0]
