"""A feedback law in the place of a planner."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from afm_rl.dynamics import Oracle
from afm_rl.errors import ConfigurationError
from afm_rl.planning.planning_env import PlanningEnv


class LawPlanner(TensorDictModuleBase):
    """A function of the state in the place of a planner: a controller, or a policy.

    In an :class:`~afm_rl.dynamics.Oracle` it sends the actions whose effects, under the regime
    that the oracle is told, are nearest to the law's: the yardstick for corrections.

    Args:
        env: the planning environment: where state and action are, the action's box, and what the
            law sees of a state.
        law: ``law(observation) -> action``, batched.

    Raises:
        ConfigurationError: if there is no law.

    >>> import torch
    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import Dubins
    >>> from afm_rl.planning import GoalDistance
    >>> env = PlanningEnv(Dubins(), GoalDistance(), [-1.0, -1.5], [1.0, 1.5])
    >>> planner = LawPlanner(env, lambda state: -2 * state[..., :2])
    >>> planner(TensorDict({"observation": torch.tensor([0.2, 5.0, 0.0])}))["action"]
    tensor([-0.4000, -1.5000])
    """

    def __init__(self, env: PlanningEnv, law: Callable[[Tensor], Tensor] | None) -> None:
        super().__init__()
        if not callable(law):
            raise ConfigurationError(f"planner.law={law!r}: expected a function of the state")
        self.env, self.law = env, law
        self.action_key = env.action_keys[0]
        self.action_spec = env.full_action_spec[self.action_key]
        self.in_keys, self.out_keys = [env.observation_key], [self.action_key]

    def _seen(self, state: Tensor) -> Tensor:
        return state if self.env.observe is None else self.env.observe(state)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        state, box = tensordict.get(self.env.observation_key), self.action_spec.space
        action = self.law(self._seen(state))
        if isinstance(self.env.dynamics, Oracle):
            action = self.env.dynamics.command(state, action, box.low, box.high)
        return tensordict.set(self.action_key, self.action_spec.project(action))
