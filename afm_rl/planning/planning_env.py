"""The environment in which planners roll out their plans."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase

from afm_rl.compiling.devices import device_of, moved
from afm_rl.dynamics import DynamicsModel, KnownDynamics
from afm_rl.errors import ConfigurationError, check_instance, refusing
from afm_rl.planning.costs import Cost
from afm_rl.spaces.keys import as_key


class PlanningEnv(ModelBasedEnvBase):
    """Dynamics model and cost as a batch-unlocked TorchRL environment.

    Any TorchRL planner can use ``step``. :meth:`returns` is the same computation for
    action sequences without tensordicts, for planners that support it.

    Args:
        dynamics: the model; shared, not copied.
        cost: cost of a step; the reward is its negative.
        action_low: lowest action, ``(A,)``; its precision is that of all entries.
        action_high: highest action, ``(A,)``.
        observation_key: key of the state.
        action_key: key of the action.
        observe: function from states ``(*B, S)`` to observations of a policy ``(*B, O)``; None: the
            states.

    Raises:
        ConfigurationError: for bounds that do not fit, and for a step function or a cost that is
            not batched; at a plan, for an entry that the environment does not give.

    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance
    >>> env = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> plans = torch.zeros(7, 5, 2)  # 7 candidates, 5 steps
    >>> env.returns(torch.zeros(3), plans, torch.ones(2)).shape
    torch.Size([7])
    """

    value: Callable[[Tensor], Tensor] | None = None
    """Cost to go ``(*B, N)`` of last states ``(*B, N, S)``, which :meth:`returns` adds; or None."""

    def __init__(
        self,
        dynamics: DynamicsModel,
        cost: Cost,
        action_low: Sequence[float] | Tensor,
        action_high: Sequence[float] | Tensor,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        observe: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        check_instance("planner.env: dynamics", dynamics, DynamicsModel)
        check_instance("planner.env: cost", cost, Cost)
        device = device_of(dynamics)  # the base class would move the model to the CPU
        super().__init__(dynamics, device=device, batch_size=torch.Size([]))
        self.dynamics = dynamics
        self.cost = cost
        self.observe = observe
        self.observation_key = as_key(observation_key)
        low, high = (1.0 * torch.as_tensor(bound) for bound in (action_low, action_high))
        fits = low.shape == high.shape == (dynamics.action_size,)
        if not fits or not bool(((low < high) & (high - low).isfinite()).all()):
            raise ConfigurationError(
                f"action bounds {low.tolist()}, {high.tolist()}: expected {dynamics.action_size} "
                "finite numbers each, low < high"
            )
        self._try(1.0 * low)
        if self.observation_key in cost.in_keys:
            raise ConfigurationError(
                f"cost.in_keys={cost.in_keys}: {self.observation_key!r} is the state already"
            )
        low, high = low.to(device), high.to(device)
        sizes = {self.observation_key: dynamics.state_size}
        sizes.update(zip(cost.in_keys, cost.in_sizes, strict=True))
        self.observation_spec = Composite()
        self.state_spec = Composite()
        for key, size in sizes.items():
            self.observation_spec[key] = Unbounded((size,), dtype=low.dtype, device=device)
            self.state_spec[key] = Unbounded((size,), dtype=low.dtype, device=device)
        spec = Bounded(low, high, shape=low.shape, dtype=low.dtype)
        self.full_action_spec = Composite({as_key(action_key): spec})
        self.reward_spec = Unbounded((1,), dtype=low.dtype, device=device)

    def _try(self, low: Tensor) -> None:
        """Try step function and cost on a batch whose size is no other size: are they batched?"""
        model, low = self.dynamics, low.to(self.device)
        batch = max(model.state_size, model.action_size) + 2, 1
        state, action = low.new_zeros(*batch, model.state_size), low.expand(*batch, -1)
        task = [low.new_zeros(*batch, size) for size in self.cost.in_sizes]
        with torch.no_grad():
            if type(model).forward is KnownDynamics.forward:  # of others the shape is known
                model(state, action)
            with refusing(f"cost: fails for states {tuple(state.shape)}"):
                found = self.cost(state, action, state, *task)
        shape = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
        if shape != batch:
            raise ConfigurationError(
                f"cost: returned {shape} for states {tuple(state.shape)} and actions "
                f"{tuple(action.shape)}; expected a tensor {batch}, one number per step: a "
                "function in torch that works on the last dimension, as in state[..., 0]"
            )

    def entries(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Return the state ``(*B, S)`` and the entries of the task from a tensordict.

        Raises:
            ConfigurationError: if one is missing.
        """
        found = []
        for key in (self.observation_key, *self.cost.in_keys):
            found.append(tensordict.get(key, None))
            if found[-1] is None:
                there = [name for name in tensordict.keys(True, True) if "next" not in name]
                raise ConfigurationError(
                    f"planner: reads {key!r}, but the environment gives {there}; name the "
                    "state with PlanningEnv(observation_key=...), and the entries that the cost "
                    "reads with its in_keys"
                )
        return found

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> PlanningEnv:
        """Move the specs too: a planner that is moved moves its modules only."""
        for name in ("_input_spec", "_output_spec"):
            self.__dict__[name] = moved(self.__dict__[name], fn)
        self.empty_cache()
        self._device = self.full_action_spec.device
        return super()._apply(fn, recurse)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        batch = tensordict.batch_size if tensordict is not None else self.batch_size
        start = self.observation_spec.zero(batch)
        if tensordict is not None:
            start.update(tensordict.select(*start.keys(True, True), strict=False))
        return start

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, *task = self.entries(tensordict)
        action = tensordict.get(self.action_key)
        next_state = self.dynamics(state, action)
        cost = self.cost(state, action, next_state, *task)
        done = torch.zeros((*cost.shape, 1), dtype=torch.bool, device=cost.device)
        ends = {"done": done, "terminated": done.clone()}
        out = TensorDict(ends, tensordict.batch_size, device=tensordict.device)
        out.set(self.observation_key, next_state)
        out.set("reward", -cost.unsqueeze(-1))
        for key, value in zip(self.cost.in_keys, task, strict=True):
            out.set(key, value)
        return out

    def returns(self, state: Tensor, actions: Tensor, *task: Tensor) -> Tensor:
        """Return the summed reward ``(*B, N)`` of each candidate plan.

        Args:
            state: ``(*B, S)``.
            actions: ``(*B, N, H, A)``.
            task: the cost's task entries, each ``(*B, size)``.
        """
        states = self.dynamics.rollout(state, actions)
        first = state[..., None, None, :].expand_as(states[..., :1, :])
        by_coordinate = [part.movedim(-1, 0) for part in (first, states[..., :-1, :])]
        before = torch.cat(by_coordinate, -1).movedim(0, -1)
        wide = [entry[..., None, None, :] for entry in task]
        total = self.cost(before, actions, states, *wide).sum(-1)
        return -total if self.value is None else -total - self.value(states[..., -1, :])
