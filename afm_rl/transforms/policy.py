"""Action flow matching inside a policy, where there is no environment to transform."""

from __future__ import annotations

from collections.abc import Callable
from typing import Unpack

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from afm_rl.compiling.devices import moved
from afm_rl.correction import Correction, Corrector
from afm_rl.correction.base import Fields
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.options import options
from afm_rl.planning.receding import ZeroPrimer
from afm_rl.spaces.keys import as_key
from afm_rl.transforms.actions import precise
from afm_rl.transforms.loop import CorrectionLoop
from afm_rl.transforms.loop_options import LoopOptions
from afm_rl.transforms.memory import Shell, entries_of, warn_of_old
from afm_rl.transforms.stateful import check_free


class ActionFlowPolicy(Shell, TensorDictModuleBase):
    """The correction of :class:`~afm_rl.transforms.ActionFlowTransform` as the end of a policy.

    Put it after a planner in a ``TensorDictSequential``: a state goes in, the action to execute
    comes out under ``action_key``, for a robot that is not an environment. It is a view of the
    :class:`~afm_rl.transforms.CorrectionLoop`, whose options it takes; it shows no observations,
    so ``delay_compensation`` does nothing: :meth:`arrival` is there for that. Under ``prefix`` are
    its entries, with the memory as ``"_memory"``, which collectors leave out; the next ones go to
    ``("next", prefix)``, as planners have it. Prime the first tensordict with
    :meth:`make_tensordict_primer` (or append that to an environment), which keeps what was learnt
    of the last step, or of the tensordict that it is given; and carry ``"next"`` on (``step_mdp``
    does). Actions are the same as the transform's.

    Args:
        model: dynamics model, shared with the planner (it does not become part of the state dict).
        action_spec: actions that the robot takes, such as ``env.action_spec``; without batch
            dimensions.
        corrector: the correction, owned; None: an
            :class:`~afm_rl.correction.ActionFlow` for ``action_spec``.
        observation_key: the state.
        action_key: where the planned action is, and the executed one goes.
        prefix: where the entries are.

    Raises:
        ConfigurationError: for parts that do not fit each other.
        KeyError: at a step, if the tensordict holds no memory: prime it first.

    >>> from tensordict import TensorDict
    >>> from tensordict.nn import TensorDictSequential
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
    >>> low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    >>> planner = MPPI(PlanningEnv(Dubins(), GoalDistance(), low, high))
    >>> policy = ActionFlowPolicy(Dubins(), planner.action_spec)
    >>> agent = TensorDictSequential(planner, policy)
    >>> td = TensorDict({"observation": torch.zeros(3), "goal": torch.ones(2)})
    >>> for part in agent:
    ...     td = part.make_tensordict_primer()(td)
    >>> agent(td)["action"].shape
    torch.Size([2])
    """

    @options("policy")
    def __init__(
        self,
        model: DynamicsModel,
        action_spec: TensorSpec,
        corrector: Corrector | None = None,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        prefix: NestedKey = "afm",
        **options: Unpack[LoopOptions],
    ) -> None:
        super().__init__()
        self.action_spec = check_instance("policy.action_spec", action_spec, Bounded)
        loop = CorrectionLoop("policy", model, corrector, **options)
        self._loop = loop.complete(action_spec=action_spec)
        self.corrector = self._loop.corrector  # registered here; the model is not
        self._residual = self._loop.residual
        if action_spec.shape != (self.corrector.action_size,):
            raise ConfigurationError(
                f"policy.action_spec: of the shape {tuple(action_spec.shape)}, expected "
                f"({self.corrector.action_size},), as corrector and model have it"
            )
        self.observation_key, self.action_key = as_key(observation_key), as_key(action_key)
        self.prefix = as_key(prefix)
        kept = [unravel_key((self.prefix, name)) for name in self._spec.keys(True, True)]
        self.in_keys = [self.observation_key, self.action_key, self.memory_key]
        self.out_keys = [self.action_key, *(unravel_key(("next", key)) for key in kept)]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ActionFlowPolicy:
        """Move the spec too."""
        self.action_spec = moved(self.action_spec, fn)
        return super()._apply(fn, recurse)

    @property
    def model(self) -> DynamicsModel:
        """The dynamics model, shared."""
        return self.loop.model

    @property
    def memory_key(self) -> NestedKey:
        """Where the memory is: collectors leave out what begins with an underscore."""
        return unravel_key((self.prefix, "_memory"))

    @property
    def enabled_key(self) -> NestedKey:
        """Key of the entry that switches single missions."""
        return unravel_key((self.prefix, "enabled"))

    @property
    def _spec(self) -> Composite:
        kind = precise(self.action_spec.dtype)
        spec = self.loop.spec(torch.Size(), self.action_spec.dtype, kind)
        state = self.corrector.lowest.new_zeros(self.model.state_size, dtype=kind)
        memory = self.corrector.begin(state, self.model)
        fields = {name: Unbounded(field.shape, dtype=kind) for name, field in memory.items()}
        spec["_memory"] = Composite(fields)
        return spec

    def arrival(self) -> Arrival:
        """Return the module that writes in which state the planned action will act."""
        return Arrival(self)

    def make_tensordict_primer(self) -> MemoryPrimer:
        """Return the transform that puts an empty memory into a tensordict, or every reset."""
        return MemoryPrimer(self)

    def empty(self, batch: torch.Size, learnt: TensorDictBase | None = None) -> TensorDictBase:
        """Return the entries of missions whose state has not been seen: it is NaN.

        With what was learnt in a memory, if one is given.
        """
        size, space = (*batch, self.model.state_size), self.action_spec.space
        nowhere = torch.full(size, torch.nan, dtype=space.low.dtype, device=space.low.device)
        fields = None if learnt is None else dict(learnt.items())
        return self._entries(*self.loop.begin(nowhere, self.action_spec, fields))

    def _entries(self, memory: Fields, step: Correction) -> TensorDictBase:
        entries = entries_of(step)
        return entries.set("_memory", TensorDict(memory, entries.batch_size, entries.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look at the state, and put the action to execute in the place of the planned one."""
        memory = tensordict.get(self.memory_key, None)
        if memory is None:
            raise KeyError(
                f"ActionFlowPolicy: no {self.prefix!r} in the tensordict; apply "
                "make_tensordict_primer() to the first one, and carry the entries of 'next' on"
            )
        warn_of_old(tensordict, self.prefix)
        state = tensordict.get(self.observation_key, None)
        memory = self.loop.observe(dict(memory.items()), state, self.observation_key)
        planned = tensordict.get(self.action_key, None)
        enabled = tensordict.get(self.enabled_key, None)
        memory, step = self.loop.act(memory, planned, self.action_spec, self.action_key, enabled)
        tensordict.set(unravel_key(("next", self.prefix)), self._entries(memory, step))
        return tensordict.set(self.action_key, step.executed_action)


class Arrival(TensorDictModuleBase):
    """Writes the state in which the next action will act to ``(prefix, "arrival")``.

    And in how many steps that will be to ``(prefix, "delay")`` ``(*B)``.

    Put it before the planner, which reads that: ``PlanningEnv(..., observation_key=("afm",
    "arrival"))``.

    Args:
        policy: the correction after the planner, whose memory it reads.
    """

    def __init__(self, policy: ActionFlowPolicy) -> None:
        super().__init__()
        self.__dict__["policy"] = policy  # shared, so not registered
        self.in_keys = [policy.observation_key, policy.memory_key]
        self.out_keys = [unravel_key((policy.prefix, name)) for name in ("arrival", "delay")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look at the state, and roll the model to where the next action will act."""
        loop, (key, memory_key) = self.policy.loop, self.in_keys
        state = tensordict.get(key, None)
        memory = dict(tensordict.get(memory_key).items())
        memory = loop.observe(memory, state, key, collect=False)
        enabled = tensordict.get(self.policy.enabled_key, None)
        reached, steps = loop.arrival(memory, enabled)
        arrival_key, delay_key = self.out_keys
        return tensordict.set(arrival_key, reached.to(state.dtype)).set(delay_key, steps)


class MemoryPrimer(ZeroPrimer):
    """Puts a policy's empty memory into a tensordict, or into every reset of an environment.

    Args:
        policy: whose memory it is.
    """

    def __init__(self, policy: ActionFlowPolicy) -> None:
        spec = policy._spec.to(policy.action_spec.device)
        super().__init__(Composite({policy.prefix: spec}))
        self.__dict__["policy"] = policy  # shared, so not registered
        self._last: TensorDictBase | None = (
            None  # the memory of the last step, which a reset does not have
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        check_free("ActionFlowPolicy", self.policy.prefix, observation_spec)
        return super().transform_observation_spec(observation_spec)

    def _reset_func(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        learnt = None
        if self.policy.options["keep_memory_on_reset"]:
            learnt = tensordict.get(self.policy.memory_key, self._last)
        entries = self.policy.empty(tensordict_reset.batch_size, learnt)
        return tensordict_reset.set(self.policy.prefix, entries)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._last = next_tensordict.get(self.policy.memory_key, None)
        return super()._step(tensordict, next_tensordict)
