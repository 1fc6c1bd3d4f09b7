"""What a planner minimises."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from afm_rl.errors import ConfigurationError, check_indices
from afm_rl.options import Natural, NonNegative, options
from afm_rl.spaces.keys import as_keys
from afm_rl.spaces.manifold import wrap_angle

GOAL_SIZE = 2  # coordinates that a goal gives


class Cost(nn.Module, ABC):
    """Cost of one imagined step, given what the environment says of the task.

    Attributes:
        in_keys: tensordict entries that describe the task, such as the goal.
        in_sizes: their sizes.
    """

    in_keys: list[NestedKey]
    in_sizes: list[int]

    @abstractmethod
    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the cost ``(*B)`` of a step to ``next_state`` ``(*B, S)``.

        ``task`` holds the entries of ``in_keys``, each ``(*B, size)`` or broadcastable.
        """


class GoalDistance(Cost):
    r"""Distance to a goal: :math:`\|W (s_{t+1} - g)\|_2` over chosen coordinates.

    The goal gives the first coordinates; a coordinate without a goal is driven to zero. So
    coordinates ``[0, 1]`` with a goal (x, y) are ``goal_position``, and ``[0, 1, 2]`` with
    the same goal are ``goal_pose`` of its authors' code, which asks for heading 0 everywhere.

    >>> cost = GoalDistance([0, 1])
    >>> here = torch.zeros(3)
    >>> cost(here, torch.zeros(2), here, torch.tensor([3.0, 4.0]))
    tensor(5.)
    """

    weights: Tensor

    @options("cost")
    def __init__(
        self,
        coordinates: Annotated[Sequence[Natural], "coordinates of the state in the cost"] = (0, 1),
        in_keys: Annotated[Sequence[NestedKey], "key of the goal"] = ("goal",),
        weights: Annotated[
            Sequence[NonNegative] | None, "weights of the coordinates; None: 1"
        ] = None,
    ) -> None:
        super().__init__()
        self.coordinates, self.in_keys = list(coordinates), as_keys(in_keys)
        self.in_sizes = [GOAL_SIZE]
        if len(self.coordinates) < GOAL_SIZE:
            raise ConfigurationError(
                f"cost.coordinates={self.coordinates}: expected at least one per goal "
                f"coordinate ({GOAL_SIZE})"
            )
        weights = [1.0] * len(self.coordinates) if weights is None else list(weights)
        if len(weights) != len(self.coordinates):
            raise ConfigurationError(
                f"cost.weights={weights}: expected {len(self.coordinates)} numbers"
            )
        self.register_buffer("weights", torch.tensor(weights), persistent=False)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the weighted distance ``(*B)``."""
        (goal,) = task
        total: Tensor | float = 0.0
        for k, coordinate in enumerate(self.coordinates):  # a handful: cheaper than gathering
            gap = next_state[..., coordinate]
            if k < goal.shape[-1]:
                gap = gap - goal[..., k]
            total = total + (self.weights[k] * gap).square()
        return torch.as_tensor(total).sqrt()


def check_arguments(name: str, function: Callable[..., Any], count: int) -> None:
    """Check that a function takes ``count`` arguments, as far as it says so.

    >>> check_arguments("cost.reward", lambda state, action, next_state: 0.0, 3)
    """
    try:
        expected = inspect.signature(function)
    except (TypeError, ValueError):  # of functions in C nothing is known
        return
    try:
        expected.bind(*[None] * count)
    except TypeError as error:
        raise ConfigurationError(
            f"{name}{expected}: expected a function of {count} arguments: state, action, next "
            f"state, and an entry of the task for each of in_keys; {error}"
        ) from error


class KnownReward(Cost):
    """The reward of somebody else's task, written down: the cost is its negative.

    Args:
        reward: ``reward(state, action, next_state, *task) -> reward``, batched.
        in_keys: tensordict entries that describe the task, if it has any.
        in_sizes: their sizes.

    >>> upright = KnownReward(lambda state, action, next_state: -state[..., 0].square())
    >>> upright(torch.tensor([3.0, 0.0]), torch.zeros(1), torch.zeros(2))
    tensor(9.)
    """

    def __init__(
        self,
        reward: Callable[..., Tensor],
        in_keys: Sequence[NestedKey] = (),
        in_sizes: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.reward = reward
        self.in_keys, self.in_sizes = as_keys(in_keys), list(in_sizes)
        if len(self.in_keys) != len(self.in_sizes):
            raise ConfigurationError(
                f"in_sizes={self.in_sizes}: expected one for each of in_keys={self.in_keys}"
            )
        check_arguments("cost.reward", reward, 3 + len(self.in_keys))

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the negative reward ``(*B)``."""
        return -self.reward(state, action, next_state, *task)


class TrackingCost(Cost):
    r"""Weighted squared distance to a reference, and squared control.

    .. math:: \sum_i w_i\,(x_i - \bar x_i)^2 + \sum_j \rho_j\,u_j^2

    The reference gives :math:`\bar x` for some coordinates, constants for the others.
    :class:`~.mpc.MPC` takes one reference per stage, or one held over the horizon.
    As the cost of a step, for planners that sample, it looks at the state that the step
    leads to, and knows held references only: the planning environment counts no stages.

    Raises:
        ConfigurationError: for settings that do not fit together.

    >>> cost = TrackingCost([1.0, 0.5], [2.0], coordinates=[0])  # a cart: position, speed
    >>> here = torch.tensor([3.0, 2.0])
    >>> cost(here, torch.ones(1), here, torch.tensor([1.0]))
    tensor(8.)
    """

    weights: Tensor
    action_weights: Tensor
    rest: Tensor
    select: Tensor

    @options("cost")
    def __init__(
        self,
        weights: Annotated[Sequence[NonNegative], "w, one per state coordinate"],
        action_weights: Annotated[Sequence[NonNegative], "rho, one per action component"],
        coordinates: Annotated[Sequence[Natural], "coordinates of the reference, in order"],
        rest: Annotated[Sequence[float] | None, "targets of the other coordinates; None: 0"] = None,
        angles: Annotated[Sequence[Natural], "coordinates in rad, whose difference wraps"] = (),
        in_keys: Annotated[Sequence[NestedKey], "key of the reference; []: none"] = ("reference",),
    ) -> None:
        super().__init__()
        size, self.in_keys = len(weights), as_keys(in_keys)
        if len(self.in_keys) != bool(coordinates):
            raise ConfigurationError(
                f"cost.in_keys={self.in_keys}: expected one key, or none without coordinates"
            )
        check_indices("cost.coordinates", coordinates, size)
        self.angles = check_indices("cost.angles", angles, size)
        rest = [0.0] * size if rest is None else list(rest)
        if len(rest) != size:
            raise ConfigurationError(f"cost.rest={rest}: expected {size} numbers")
        self.in_sizes = [len(coordinates)] * len(self.in_keys)
        select = torch.zeros(len(coordinates), size).double()
        for row, coordinate in enumerate(coordinates):
            select[row, coordinate] = 1.0
        tensors = {"weights": weights, "action_weights": action_weights, "rest": rest}
        for name, values in tensors.items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)
        self.rest *= 1.0 - select.sum(0)
        self.register_buffer("select", select, persistent=False)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, *task: Tensor) -> Tensor:
        """Return the cost ``(*B)`` of an action and of the state that it leads to."""
        self._check_sizes(next_state, action)
        off = self._gap(next_state, *task).square() @ self.weights.to(next_state)
        return off + action.square() @ self.action_weights.to(action)

    def quadratic(
        self, states: Tensor, actions: Tensor, *task: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the expansion of a trajectory's cost to second order, which is exact.

        Args:
            states: ``(*B, N + 1, S)``.
            actions: ``(*B, N, A)``.
            task: the reference ``(*B, N + 1, size)``, or ``(*B, 1, size)`` for all stages.

        Returns:
            Hessian ``(*B, N + 1, S, S)`` and gradient ``(*B, N + 1, S)`` in the states, and
            ``(*B, N, A, A)`` and ``(*B, N, A)`` in the actions.
        """
        self._check_sizes(states, actions)
        state_twice = 2.0 * self.weights.to(states)
        action_twice = 2.0 * self.action_weights.to(actions)
        return (
            state_twice.diag().expand(*states.shape, -1),
            state_twice * self._gap(states, *task),
            action_twice.diag().expand(*actions.shape, -1),
            action_twice * actions,
        )

    def _check_sizes(self, states: Tensor, actions: Tensor) -> None:
        sizes = states.shape[-1], actions.shape[-1]
        if sizes != (len(self.weights), len(self.action_weights)):
            raise ConfigurationError(
                f"cost: weights for {len(self.weights)} state coordinates and "
                f"{len(self.action_weights)} action components, but there are "
                f"{sizes[0]} and {sizes[1]}"
            )

    def _gap(self, state: Tensor, *reference: Tensor) -> Tensor:
        """Return by how much states ``(*B, S)`` miss the targets."""
        gap = state - self.rest.to(state)
        for given in reference:
            gap = gap - given.to(state) @ self.select.to(state)
        if self.angles:
            gap[..., self.angles] = wrap_angle(gap[..., self.angles])
        return gap
