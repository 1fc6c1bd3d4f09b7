"""A planner that searches far from a goal, and a linear feedback near to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from afm_rl.errors import ConfigurationError, check_instance
from afm_rl.options import NonNegative, options
from afm_rl.planning import PlanningEnv, TrackingCost
from afm_rl.planning.receding import RecedingHorizonPlanner
from afm_rl.planning.riccati import stationary_value


class Handover(RecedingHorizonPlanner):
    r"""Plans with another planner, and hands over to LQR where LQR is sufficient.

    Around the equilibrium :math:`\bar x` at which the cost is least, the model is linearised at
    every tick, for every mission, and :func:`~afm_rl.planning.riccati.stationary_value` gives the
    cost to go :math:`V(x) = e^\top P e` and the feedback :math:`u = -K e`, :math:`e = x \ominus
    \bar x`. It acts where V is at most ``level`` and its action is within the action bounds.
    Elsewhere the other planner acts, which begins again when it takes over again. To each of its
    plans ``min(V, cap)`` of the last state is added (:attr:`PlanningEnv.value`): so plans need not
    reach the goal, and the cap ignores the linear model where it does not hold.

    Args:
        env: a :class:`PlanningEnv` whose cost is a :class:`TrackingCost` without a task.
        far: makes the other planner of the environment, such as :class:`ICEM` or :class:`MPPI`,
            whose memory is in the tensordict.
        settings: of the other planner.

    Raises:
        ConfigurationError: for incompatible parts.

    >>> from tensordict import TensorDict
    >>> from afm_rl.dynamics import KnownDynamics
    >>> from afm_rl.planning import ICEM, TrackingCost
    >>> from afm_rl.spaces.manifold import Manifold
    >>> def push(state, force):  # a cart: position (m), speed (m/s); force (N)
    ...     return state + 0.1 * torch.cat([state[..., 1:], force], -1)
    >>> cost = TrackingCost([1.0, 0.1], [0.1], coordinates=[], in_keys=[])
    >>> env = PlanningEnv(KnownDynamics(push, Manifold(2), 1), cost, [-1.0], [1.0])
    >>> planner = Handover(env, ICEM, level=1.0)
    >>> td = TensorDict({"observation": torch.tensor([[0.1, 0.0], [9.0, 0.0]])}, [2])
    >>> planner(planner.make_tensordict_primer()(td))["action"].round(decimals=2)
    tensor([[-0.2800],
            [-1.0000]])
    """

    @options("planner")
    def __init__(
        self,
        env: PlanningEnv,
        far: Callable[..., RecedingHorizonPlanner],
        level: Annotated[NonNegative, "largest cost to go at which LQR acts"] = 4.0,
        cap: Annotated[
            NonNegative, "weight of the cost to go at the end of a plan; 0: none"
        ] = 20.0,
        action_key: Annotated[NestedKey, "key of the action"] = "action",
        **settings: Any,
    ) -> None:
        cost = check_instance("planner.env", env, PlanningEnv).cost
        if not isinstance(cost, TrackingCost) or cost.in_keys:
            raise ConfigurationError(
                f"planner: Handover needs a TrackingCost without a task, with in_keys=[] and "
                f"coordinates=[]; got {type(cost).__name__} with {cost.in_keys}"
            )
        planner = far(env, action_key=action_key, **settings)
        check_instance("planner.far", planner, RecedingHorizonPlanner)
        super().__init__(env, planner.memory, action_key)
        self.far = planner
        self.level, self.cap = level, cap
        self.in_keys = list(planner.in_keys)

    def regulator(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the goal ``(*B, S)``, P ``(*B, S, S)`` and K ``(*B, A, S)``.

        Of a shared model they have dimensions of size 1.
        """
        dynamics, cost = self.env.dynamics, cast(TrackingCost, self.env.cost)
        batch = state.shape[:-1] if dynamics.lead else torch.Size([1] * (state.dim() - 1))
        still = state.new_zeros(*batch, 1, dynamics.action_size)
        origin = state.new_zeros(*batch, 2, dynamics.state_size)
        by_state, slope, by_action, _ = cost.quadratic(origin, still)
        curvature = by_state[..., 0, :, :]
        goal = -(torch.linalg.pinv(curvature) @ slope[..., 0, :, None]).squeeze(-1)
        _, move, push = dynamics.linearise(goal, still[..., 0, :])
        value, gain = stationary_value(move, push, curvature / 2, by_action[..., 0, :, :] / 2)
        return goal, value, gain

    @torch.no_grad()
    def plan(self, td: TensorDictBase) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the feedback's action or the other planner's, and the latter's memory."""
        (state,), space = self.env.entries(td), self.action_spec.space
        goal, value, gain = self.regulator(state)
        error = self.env.dynamics.manifold.difference(state, goal.expand_as(state))
        action = -(gain @ error.unsqueeze(-1)).squeeze(-1)

        def togo(states: Tensor) -> Tensor:  # (*B, N, S); infinite where there is no feedback
            origin = goal.unsqueeze(-2).expand_as(states)
            off = self.env.dynamics.manifold.difference(states, origin)
            return ((off @ value) * off).sum(-1).nan_to_num(torch.inf, torch.inf, torch.inf)

        inside = ((action >= space.low) & (action <= space.high)).all(-1)
        near = inside & (togo(state.unsqueeze(-2)).squeeze(-1) <= self.level)
        if bool(near.all()):
            return action, [torch.zeros_like(entry) for entry in self._recall(td)]
        if self.cap:
            self.env.value = lambda states: togo(states).clamp(max=self.cap)
        planned, memory = self.far.plan(td)
        self.env.value = None
        rows = [near.reshape(*near.shape, *[1] * (x.dim() - near.dim())) for x in memory]
        kept = [x.masked_fill(row, 0.0) for row, x in zip(rows, memory, strict=True)]
        return torch.where(near.unsqueeze(-1), action.to(planned), planned), kept
