"""Action flow matching inside a policy, where there is no environment to transform."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, Composite, TensorSpec

from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.flow import Corrector
from afm_rl.keys import as_key
from afm_rl.planning.primer import ZeroPrimer
from afm_rl.transforms.memory import begin, check_parts, correct, memory_spec, observe


class ActionFlowPolicy(TensorDictModuleBase):
    """The correction of :class:`~afm_rl.transforms.ActionFlowTransform` as the end of a policy.

    Put it after a planner in a ``TensorDictSequential``: a state goes in, the action to execute
    comes out under ``action_key``, as a robot wants it that is no environment. Planned action and
    memory are under ``prefix``, with the entries that the transform has; the next memory goes to
    ``("next", prefix)``, as planners have it. Prime the first tensordict with
    :meth:`make_tensordict_primer` (or append that to an environment), and carry ``"next"`` on
    (``step_mdp`` does). Actions are the same as the transform's.

    Args:
        model: dynamics model, shared with the planner (it does not become part of the state dict).
        flow: the correction; owned.
        action_spec: actions that the robot takes, such as ``env.action_spec``; without batch
            dimensions.
        observation_key: the state.
        action_key: where the planned action is, and the executed one goes.
        prefix: where the memory is kept.
        enabled: False to watch only.
        extend_action_box: let planners know of effects beyond the action box, if the model can
            foresee them.

    Raises:
        ConfigurationError: for parts that do not fit each other.

    >>> from tensordict import TensorDict
    >>> from tensordict.nn import TensorDictSequential
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.flow import LeastSquares
    >>> from afm_rl.planning import MPPI, GoalDistance, PlanningEnv
    >>> low, high = torch.tensor([-1.0, -1.5]), torch.tensor([1.0, 1.5])
    >>> planner = MPPI(PlanningEnv(Dubins(), GoalDistance(), low, high))
    >>> policy = ActionFlowPolicy(Dubins(), LeastSquares(low, high), planner.action_spec)
    >>> agent = TensorDictSequential(planner, policy)
    >>> td = TensorDict({"observation": torch.zeros(3), "goal": torch.ones(2)})
    >>> for part in agent:
    ...     td = part.make_tensordict_primer()(td)
    >>> agent(td)["action"].shape
    torch.Size([2])
    """

    def __init__(
        self,
        model: DynamicsModel,
        flow: Corrector,
        action_spec: TensorSpec,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        prefix: NestedKey = "afm",
        enabled: bool = True,
        extend_action_box: bool = True,
    ) -> None:
        super().__init__()
        check_parts("policy", model, flow, enabled, extend_action_box)
        self.flow = flow
        self.action_spec = check_instance("policy.action_spec", action_spec, Bounded)
        if action_spec.shape != (flow.action_size,):
            raise ConfigurationError(
                f"policy.action_spec: of the shape {tuple(action_spec.shape)}, expected "
                f"({flow.action_size},), as flow and model have it"
            )
        self.__dict__["model"] = model  # shared with the planner, so not registered
        self.observation_key, self.action_key = as_key(observation_key), as_key(action_key)
        self.prefix = as_key(prefix)
        self.enabled, self.extend_action_box = enabled, extend_action_box
        names = memory_spec(model, flow, torch.Size(), action_spec.dtype).keys(True, True)
        kept = [unravel_key((self.prefix, name)) for name in names]
        self.in_keys = [self.observation_key, self.action_key, *kept]
        self.out_keys = [self.action_key, *(unravel_key(("next", key)) for key in kept)]

    def make_tensordict_primer(self) -> MemoryPrimer:
        """Return the transform that puts an empty memory into a tensordict, or every reset."""
        return MemoryPrimer(self)

    def empty(self, batch: torch.Size) -> TensorDictBase:
        """Return the memory of missions whose state has not been seen: it is NaN."""
        size, space = (*batch, self.model.state_size), self.action_spec.space
        nowhere = torch.full(size, torch.nan, dtype=space.low.dtype, device=space.low.device)
        return begin(self.model, self.flow, nowhere, self.action_spec)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look at the state, and put the action to execute in the place of the planned one."""
        memory = tensordict.get(self.prefix, None)
        if memory is None:
            raise KeyError(
                f"ActionFlowPolicy: no {self.prefix!r} in the tensordict; apply "
                "make_tensordict_primer() to the first one, and carry the entries of 'next' on"
            )
        planned = tensordict.get(self.action_key)
        settings = self.model, self.flow, self.action_spec, self.enabled, self.extend_action_box
        memory = observe(memory, tensordict.get(self.observation_key))
        memory = correct(memory, planned, *settings)
        tensordict.set(unravel_key(("next", self.prefix)), memory)
        return tensordict.set(self.action_key, memory.get("executed_action"))


class MemoryPrimer(ZeroPrimer):
    """Puts a policy's empty memory into a tensordict, or into every reset of an environment.

    Args:
        policy: whose memory it is.
    """

    def __init__(self, policy: ActionFlowPolicy) -> None:
        spec = memory_spec(policy.model, policy.flow, torch.Size(), policy.action_spec.dtype)
        super().__init__(Composite({policy.prefix: spec.to(policy.action_spec.device)}))
        self.__dict__["policy"] = policy  # shared, so not registered

    def _reset_func(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        memory = self.policy.empty(tensordict_reset.batch_size)
        return tensordict_reset.set(self.policy.prefix, memory)
