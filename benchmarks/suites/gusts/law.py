"""A feedback law as a planner."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from afm_rl.dynamics import Oracle
from afm_rl.planning import PlanningEnv


class LawPlanner(TensorDictModuleBase):
    """A function of the state as a planner.

    In an :class:`~afm_rl.dynamics.Oracle` it sends the actions whose effects, under the regime of
    the oracle, are nearest to the law's.

    Args:
        env: the planning environment: the keys of state and action, and the action bounds.
        law: ``law(state) -> action``, batched.

    >>> import torch
    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance
    >>> env = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> planner = LawPlanner(env, lambda state: -2 * state[..., :2])
    >>> planner(TensorDict({"observation": torch.tensor([0.2, 5.0, 0.0])}))["action"]
    tensor([-0.4000, -1.5000])
    """

    def __init__(self, env: PlanningEnv, law: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.env, self.law = env, law
        self.in_keys, self.out_keys = [env.observation_key], list(env.action_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        state, spec = tensordict.get(self.env.observation_key), self.env.action_spec
        action = self.law(state)
        if isinstance(self.env.dynamics, Oracle):
            action = self.env.dynamics.command(state, action, spec.space.low, spec.space.high)
        return tensordict.set(self.out_keys[0], spec.project(action))
