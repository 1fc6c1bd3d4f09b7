"""The world as the planner imagines it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase

from afm_rl.compiling.devices import device_of, moved
from afm_rl.dynamics import DynamicsModel
from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.planning.costs import Cost
from afm_rl.spaces.keys import as_key


class PlanningEnv(ModelBasedEnvBase):
    """Dynamics model and cost as a batch-unlocked TorchRL environment.

    ``step`` is what any TorchRL planner needs; :meth:`returns` is the same computation for
    whole action sequences without tensordicts, for planners that know it.

    Args:
        dynamics: the model; shared, not copied.
        cost: cost of a step; the reward is its negative.
        action_low: lowest action, ``(A,)``; its precision is that of all entries.
        action_high: highest action, ``(A,)``.
        observation_key: where the state is.
        action_key: where the action is.
        observe: what a policy sees of states ``(*B, S)``, ``(*B, O)``; the states if None.

    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance
    >>> env = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> plans = torch.zeros(7, 5, 2)  # 7 candidates, 5 steps
    >>> env.returns(torch.zeros(3), plans, torch.ones(2)).shape
    torch.Size([7])
    """

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
        if self.observation_key in cost.in_keys:
            raise ConfigurationError(
                f"cost.in_keys={cost.in_keys}: {self.observation_key!r} holds the state already"
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
        state, action = tensordict.get(self.observation_key), tensordict.get(self.action_key)
        task = {key: tensordict.get(key) for key in self.cost.in_keys}
        next_state = self.dynamics(state, action)
        cost = self.cost(state, action, next_state, *task.values())
        done = torch.zeros((*cost.shape, 1), dtype=torch.bool, device=cost.device)
        ends = {"done": done, "terminated": done.clone()}
        out = TensorDict(ends, tensordict.batch_size, device=tensordict.device)
        out.set(self.observation_key, next_state)
        out.set("reward", -cost.unsqueeze(-1))
        for key, value in task.items():
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
        return -self.cost(before, actions, states, *wide).sum(-1)
